"""sdfnet: tiny neural networks that answer how far a deforming surface is, and what each digit of that answer costs.

The stages, left to right; each is a plain function of a frozen configuration and of what the stage before it made:
`scene` (what) -> `geometry` (tet mesh) -> `physics` (frames) -> `data` (signed distances) -> `models` and `training`
(networks) -> `evaluation` (surfaces).

Axis names used in shape annotations: nodes, tets, vertices, faces, frames, points, features, latent, triangles.
Units are SI. Distance is negative inside the solid.
"""
