"""From a description of a solid to a tet mesh of fixed topology, and the signed distance to its deforming surface."""
