"""What a simulation gives: the displacement of every node at the recorded times."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A family of shapes with one topology. Frame 0 is the rest state."""

    mesh: TetMesh
    times: Float64[np.ndarray, " frames"]  # s
    displacements: Float64[np.ndarray, "frames nodes 3"]  # m
    time_step: float  # s, really taken
    report: dict[str, float | int | str]  # how it was made and how well; units in the names

    @property
    def surface_vertices(self) -> Float64[np.ndarray, "frames vertices 3"]:
        """The boundary's vertices at every frame, m."""
        nodes = self.mesh.surface_nodes
        return self.mesh.nodes[nodes] + self.displacements[:, nodes]

    def surface(self, frame: int) -> Surface:
        """The deformed boundary surface at a frame; its vertices are `mesh.surface_nodes`."""
        return self.mesh.surface(self.displacements[frame])
