"""A part of the solid that is made of something else."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

from sdfnet.errors import PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.roles import ChangesMaterial
from sdfnet.physics.regions import BoxRegion, Region
from sdfnet.scene import Material


@dataclass(frozen=True)
class Inclusion(ChangesMaterial):
    """E, nu and rho = `material` in place of the scene's, E in Pa, for the tets whose centroid lies in `region`.

    For a bone in flesh, a core, a layer, a stiff insert: the two are bonded where they meet. The step of explicit
    integrators is governed by the faster material: with a contrast of 1e6 in stiffness take newmark, or wait a thousand
    times as long. The surface between the materials follows the faces of the mesh: not for a region that is
    thinner than a few tets, or one whose shape matters and which the mesh does not know.
    """

    region: Region = field(default_factory=BoxRegion)  # all of it, unless told
    material: Material = field(default_factory=Material)

    def tets(self, mesh: TetMesh) -> Bool[np.ndarray, " tets"]:
        """True for the tets that are made of it. Raises PhysicsError when none is."""
        centroids = mesh.nodes[mesh.tets].mean(axis=1)
        inside = self.region.contains(centroids)
        if not inside.any():
            where = self.region.beside(centroids)
            raise PhysicsError(f"an inclusion must hold the centroid of a tet, found none: {where}; move or enlarge inclusion.region, or refine the mesh")
        return inside
