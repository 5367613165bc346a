"""Where a displacement lives: the corners of the tets, and for quadratic elements the middles of their edges too."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sdfnet.geometry.tetmesh import TetMesh

FACE_EDGES = ((0, 1), (1, 2), (2, 0))
MIDDLE_ENDS = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))  # the corners about the fifth to tenth node of a quadratic tet


@dataclass(frozen=True, eq=False)
class FiniteElements:
    """The nodes of the displacement on a tet mesh. The corners come first, numbered as in the mesh.

    Degree of freedom 3 * node + component. Made by `elasticity.finite_elements`.
    """

    mesh: TetMesh
    element: str  # P1, P1_nodal_pressure or P2: see `Solver.element`
    nodes: Float64[np.ndarray, "nodes 3"]  # m
    tets: Int64[np.ndarray, "tets corners"]  # 4 nodes of each tet, or 10

    @property
    def is_quadratic(self) -> bool:
        """Whether the middles of the edges are nodes."""
        return self.tets.shape[1] == 10

    @cached_property
    def boundary_faces(self) -> Int64[np.ndarray, "faces corners"]:
        """The nodes of each boundary face: its 3 corners, then for quadratic elements the middles of its edges 01, 12, 20."""
        corners = self.mesh.boundary_faces
        if not self.is_quadratic:
            return corners
        ends = np.sort(np.concatenate([corners[:, edge] for edge in FACE_EDGES]), axis=1)
        keys = self._edge_ends @ [len(self.mesh.nodes), 1]
        order = np.argsort(keys)
        middles = len(self.mesh.nodes) + order[np.searchsorted(keys, ends @ [len(self.mesh.nodes), 1], sorter=order)]
        return np.concatenate([corners, middles.reshape(3, -1).T], axis=1)

    @cached_property
    def is_on_boundary(self) -> Bool[np.ndarray, " nodes"]:
        """True for the nodes of the surface."""
        mask = np.zeros(len(self.nodes), dtype=np.bool_)
        mask[self.boundary_faces] = True
        return mask

    @cached_property
    def part_of(self) -> Int64[np.ndarray, " nodes"]:
        """The number of the connected part that each node belongs to, from 0; parts share no node, and so move apart."""
        ends = np.repeat(self.tets[:, :1], self.tets.shape[1] - 1, axis=1).ravel(), self.tets[:, 1:].ravel()
        _, parts = connected_components(coo_matrix((np.ones(len(ends[0])), ends), shape=2 * (len(self.nodes),)), directed=False)
        return parts.astype(np.int64)

    @cached_property
    def surface_areas(self) -> Float64[np.ndarray, " nodes"]:
        """The share of the surface that each node stands for, m^2: an equal part of every face to each of its nodes. Zero inside."""
        corners = self.mesh.nodes[self.mesh.boundary_faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        faces = self.boundary_faces
        return np.bincount(faces.ravel(), np.repeat(areas / faces.shape[1], faces.shape[1]), minlength=len(self.nodes))

    @cached_property
    def _edge_ends(self) -> Int64[np.ndarray, "edges 2"]:
        """The two corners of the edge whose middle is node len(mesh.nodes) + i, ascending."""
        ends = np.empty((len(self.nodes) - len(self.mesh.nodes), 2), dtype=np.int64)
        for local, (first, second) in enumerate(MIDDLE_ENDS):
            ends[self.tets[:, 4 + local] - len(self.mesh.nodes)] = np.sort(self.tets[:, [first, second]], axis=1)
        return ends
