"""From a scene and a tet mesh to the displacements at the recorded times (paper section 2)."""
