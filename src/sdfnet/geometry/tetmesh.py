"""The tet mesh whose topology every frame shares, with its boundary surface."""

import hashlib
import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from sdfnet.checked import Checked
from sdfnet.errors import GeometryError
from sdfnet.geometry.surface import Surface, near_points, place_text

logger = logging.getLogger(__name__)

# The four faces of a tet, wound so that their normals leave it when its volume is positive.
TET_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
TET_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


@dataclass(frozen=True)
class WorstTet:
    """The most slender tet of a mesh, and how slender it is."""

    index: int
    place: tuple[float, float, float]  # m, its centroid
    aspect_ratio: float  # 1.22 when regular
    smallest_altitude: float  # m; the stable time step shrinks with it


@dataclass(frozen=True, eq=False)
class TetMesh(Checked):
    """Nodes and tets of a solid at rest.

    Slivers are taken, however slender: the time step pays for them. Nodes at one place are taken with a warning, for
    the solid is cracked there. Raises GeometryError when a tet is inverted or flat, when one is there twice, when more
    than two share a face, when one names a node that does not exist, or when a number is not finite: a step
    through such a mesh is never right.
    """

    nodes: Float64[np.ndarray, "nodes 3"]  # m
    tets: Int64[np.ndarray, "tets 4"]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.tets) == 0:
            raise GeometryError("a tet mesh needs at least one tet, found none")
        if not np.isfinite(self.nodes).all():
            raise GeometryError(f"tet mesh nodes must be finite, found {int((~np.isfinite(self.nodes)).any(axis=1).sum())} that are not")
        if self.tets.min() < 0 or self.tets.max() >= len(self.nodes):
            raise GeometryError(
                f"tets must be rows of four node numbers from 0 to {len(self.nodes) - 1}, found numbers from {self.tets.min()} to {self.tets.max()}; "
                "count nodes from 0, and drop no node that a tet names"
            )
        bad = np.flatnonzero(self.volumes <= 0)
        if len(bad):
            raise GeometryError(
                f"every tet must have positive volume, found {len(bad)} inverted or flat, the first at index {bad[0]}, "
                f"{place_text(self._centroid(int(bad[0])))} m; mesh the solid again, or swap two corners of each inverted tet"
            )
        _, first = np.unique(np.sort(self.tets, axis=1), axis=0, return_index=True)
        if len(first) < len(self.tets):
            again = int(np.setdiff1d(np.arange(len(self.tets)), first)[0])
            raise GeometryError(
                f"every tet must be there once, found {len(self.tets) - len(first)} again, the first at index {again}, "
                f"{place_text(self._centroid(again))} m; leave the repeated ones out, their stiffness and mass would count twice"
            )
        faces, _, uses = self._faces_once
        crowded = faces[uses > 2]
        if len(crowded):
            raise GeometryError(
                f"a face must belong to one tet or two, found {len(crowded)} of more, the first about "
                f"{place_text(tuple(self.nodes[crowded[0]].mean(axis=0)))} m; mesh the solid again, tets overlap there"
            )
        used = np.unique(self.tets)
        near = used[near_points(self.nodes[used])]
        if len(near):
            logger.warning(
                "%d nodes of the tet mesh lie upon another, the first at index %d, %s m; the solid is cracked there and opens when it moves; merge them",
                len(near),
                near[0],
                place_text(self.nodes[near[0]]),
            )

    @cached_property
    def volumes(self) -> Float64[np.ndarray, " tets"]:
        """Volume of each tet, m^3; negative where it is inverted."""
        a, b, c, d = (self.nodes[self.tets[:, k]] for k in range(4))
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0

    @cached_property
    def smallest_edge(self) -> float:
        """Length of the shortest edge, m: the paper's h."""
        ends = self.nodes[self.tets[:, TET_EDGES]]
        return float(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1).min())

    @cached_property
    def smallest_altitudes(self) -> Float64[np.ndarray, " tets"]:
        """The smallest altitude of each tet, m: three times its volume over its largest face."""
        a, b, c = (self.nodes[self.tets[:, TET_FACES[:, k]]] for k in range(3))
        return 6.0 * self.volumes / np.linalg.norm(np.cross(b - a, c - a), axis=-1).max(axis=1)

    @cached_property
    def aspect_ratios(self) -> Float64[np.ndarray, " tets"]:
        """Longest edge over smallest altitude of each tet: sqrt(3/2) = 1.2247 when regular, without limit as it grows flat."""
        ends = self.nodes[self.tets[:, TET_EDGES]]
        return np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1).max(axis=1) / self.smallest_altitudes

    @cached_property
    def worst(self) -> WorstTet:
        """The tet of the largest aspect ratio."""
        index = int(self.aspect_ratios.argmax())
        return WorstTet(index, self._centroid(index), float(self.aspect_ratios[index]), float(self.smallest_altitudes[index]))

    @cached_property
    def diagonal(self) -> float:
        """D: length of the rest bounding box diagonal, m."""
        return float(np.linalg.norm(np.ptp(self.nodes[self.boundary_faces.ravel()], axis=0)))

    @cached_property
    def boundary_faces(self) -> Int64[np.ndarray, "faces 3"]:
        """The faces that belong to one tet only, as node indices, normals outward."""
        _, first, uses = self._faces_once
        return self.tets[:, TET_FACES].reshape(-1, 3)[np.sort(first[uses == 1])]

    @cached_property
    def surface_nodes(self) -> Int64[np.ndarray, " vertices"]:
        """The nodes on the boundary, ascending; row i of a frame's surface is node surface_nodes[i]."""
        return np.unique(self.boundary_faces)

    @cached_property
    def surface_faces(self) -> Int64[np.ndarray, "faces 3"]:
        """The boundary faces numbered in surface vertices."""
        return np.searchsorted(self.surface_nodes, self.boundary_faces)

    def surface(self, displacement: Float64[np.ndarray, "nodes 3"] | None = None) -> Surface:
        """The boundary surface, at rest or displaced (m)."""
        vertices = self.nodes[self.surface_nodes]
        if displacement is not None:
            vertices = vertices + displacement[self.surface_nodes]
        return Surface(vertices, self.surface_faces)

    @cached_property
    def digest(self) -> str:
        """A hash of nodes and tets: what is made from this mesh is named by it, because fTetWild differs from run to run."""
        content = hashlib.sha256(np.ascontiguousarray(self.nodes).tobytes())
        content.update(np.ascontiguousarray(self.tets).tobytes())
        return content.hexdigest()[:12]

    @cached_property
    def edges(self) -> tuple[Int64[np.ndarray, "edges 2"], Int64[np.ndarray, "tets 6"]]:
        """The ends of every edge as ascending node numbers, each edge once, and which edges the TET_EDGES of each tet are."""
        ends, numbers = np.unique(np.sort(self.tets[:, TET_EDGES].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
        return ends, numbers.reshape(-1, 6)

    @cached_property
    def _faces_once(self) -> tuple[Int64[np.ndarray, "faces 3"], Int64[np.ndarray, " faces"], Int64[np.ndarray, " faces"]]:
        """Each face as ascending node numbers, where it stands first among the faces of all tets, and in how many it is."""
        faces, first, uses = np.unique(np.sort(self.tets[:, TET_FACES].reshape(-1, 3), axis=1), axis=0, return_index=True, return_counts=True)
        return faces, first, uses

    def _centroid(self, index: int) -> tuple[float, float, float]:
        x, y, z = self.nodes[self.tets[index]].mean(axis=0)
        return float(x), float(y), float(z)
