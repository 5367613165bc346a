"""What a simulation gives: the displacement of every node at the recorded times."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import displacement_gradients


@dataclass(frozen=True, eq=False)
class FrameChecks:
    """What is broken in each frame. In a broken frame "inside" is doubtful where surfaces overlap."""

    inverted_tets: Int64[np.ndarray, " frames"]  # tets with a volume of zero or less
    crossing_faces: Int64[np.ndarray, " frames"]  # pairs of surface faces that pass through each other

    @property
    def broken(self) -> list[int]:
        """The frames in which a tet is inverted or a face crosses another."""
        return np.flatnonzero((self.inverted_tets > 0) | (self.crossing_faces > 0)).tolist()

    def sentence(self) -> str:
        """Which frames are broken and how, for a message."""
        broken = self.broken
        worst = max(broken, key=lambda frame: (self.crossing_faces[frame], self.inverted_tets[frame]))
        return (
            f"{len(broken)} of {len(self.inverted_tets)} frames are broken, the first is frame {broken[0]}; the worst, frame {worst}, "
            f"has {self.inverted_tets[worst]} inverted tets and {self.crossing_faces[worst]} pairs of faces that cross"
        )


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A family of shapes with one topology. Frame 0 is the state at time 0; the frames of load cases follow one another."""

    mesh: TetMesh
    times: Float64[np.ndarray, " frames"]  # s
    displacements: Float64[np.ndarray, "frames nodes 3"]  # m
    time_step: float  # s, really taken
    report: dict[str, float | int | str]  # how it was made and how well; units in the names
    cases: tuple[str, ...] = ()  # names of the load cases; empty for a single one
    checks: FrameChecks | None = None  # what is broken in each frame; none where nobody asked

    @cached_property
    def inverted_tets(self) -> Int64[np.ndarray, " frames"]:
        """How many tets of each frame have a volume of zero or less."""
        gradients = displacement_gradients(self.mesh, self.displacements)
        return np.array([(np.linalg.det(gradient + np.eye(3)) <= 0).sum() for gradient in gradients], dtype=np.int64)

    @property
    def surface_vertices(self) -> Float64[np.ndarray, "frames vertices 3"]:
        """The boundary's vertices at every frame, m."""
        nodes = self.mesh.surface_nodes
        return self.mesh.nodes[nodes] + self.displacements[:, nodes]

    @property
    def surface_normals(self) -> Float64[np.ndarray, "frames vertices 3"]:
        """Unit normals of the boundary at its vertices, outward, each the mean of its faces' weighted by their angles."""
        return np.stack([self.surface(frame).as_trimesh().vertex_normals for frame in range(len(self.times))])

    def surface(self, frame: int) -> Surface:
        """The deformed boundary surface at a frame; its vertices are `mesh.surface_nodes`."""
        return self.mesh.surface(self.displacements[frame])

    def case(self, name: str) -> "Trajectory":
        """The frames of one load case. Raises ConfigurationError for a name that is none."""
        if name not in self.cases:
            raise ConfigurationError(f"no load case '{name}'; known are {', '.join(self.cases)}")
        count = len(self.times) // len(self.cases)
        part = slice(self.cases.index(name) * count, (self.cases.index(name) + 1) * count)
        checks = None if self.checks is None else FrameChecks(self.checks.inverted_tets[part], self.checks.crossing_faces[part])
        return Trajectory(self.mesh, self.times[part], self.displacements[part], self.time_step, self.report, checks=checks)
