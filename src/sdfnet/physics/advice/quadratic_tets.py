"""What quadratic tets would answer, from the linear ones and their factor: no matrix is assembled and none factorised."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csr_matrix

from sdfnet.geometry.tetmesh import TET_EDGES, TetMesh
from sdfnet.physics.advice.reduced_model import Answers
from sdfnet.physics.elasticity import ElasticModel, shape_gradients
from sdfnet.physics.materials import per_tet

MOST_ITERATIONS = 60  # of conjugate gradients; a beam, a ball and the bunny take 12 to 20 up to a Poisson ratio of 0.45, near 0.5 twice as many
LAST_GAIN = 1e-3  # of the energy gained so far: an iteration that adds less is the last; 1e-2 stopped P1_nodal_pressure at 0.49 at a third of the change
EDGES_AT = np.array([[0, 1, 2], [0, 3, 4], [1, 3, 5], [2, 4, 5]])  # of TET_EDGES, those at each corner
FAR_ENDS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # their other ends


@dataclass(frozen=True, eq=False)
class QuadraticAnswer:
    """Displacements of quadratic tets, one a column."""

    corners: Float64[np.ndarray, "dofs columns"]  # m, on the free degrees of freedom of the corners
    worked: Float64[np.ndarray, "dofs columns"]  # m, what forces on the corners do work on when they are spread over the edges too
    stiffness: Float64[np.ndarray, "columns columns"]  # J, their products in the stiffness of quadratic tets


class QuadraticTets:
    """K of the quadratic tets on a linear model's mesh, in hierarchical coordinates: u = sum c_i N_i + sum b_ij 4 N_i N_j.

    N_i is the linear shape function of corner i, so that c is the displacement of the corners and b = 0 is a linear
    field; rows of u are the corners, then the edges. grad u is linear in a tet: c_i (x) grad N_i summed, plus at corner k
    the sum of 4 b_kj (x) grad N_j. With integral N_k N_l = V (1 + delta_kl) / 20 all integrals are exact. An edge with
    both ends held is held. A force on a corner is taken for that of a force density which the linear shape functions
    spread, as gravity and inertia are; else it would dent quadratic tets like a needle.
    """

    def __init__(self, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> None:
        mesh = model.mesh
        self._volumes, self._gradients = mesh.volumes, shape_gradients(mesh)
        self._lambda, self._mu = model.material.lame_lambda, model.material.lame_mu
        self.ends, self._edges = mesh.edges
        self._count = len(mesh.nodes)
        self._moves = ~np.concatenate([fixed, fixed[self.ends].all(axis=1)])
        self._gradient = self._corner_gradients(mesh)
        self._force_of_stress = csr_matrix(self._gradient.T)
        self._spread, self._edge_answers = self._spreading(mesh), self._inverse_edge_blocks()

    def answer(self, linear: Answers, shapes: Float64[np.ndarray, "dofs columns"], forces: Float64[np.ndarray, "dofs columns"]) -> QuadraticAnswer:
        """Static answers to forces (N) on the corners, from the linear ones (m).

        By conjugate gradients, preconditioned by `linear` for the corners and by each edge by itself.
        """
        solved = [self._solved(linear, shape, force) for shape, force in zip(shapes.T, forces.T, strict=True)]
        displacements, loads = (np.stack([column[part] for column in solved], axis=-1) for part in (0, 1))
        energies = np.einsum("nai,naj->ij", displacements, loads)
        at_corners = displacements[: self._count]
        worked = at_corners + np.stack([self._spread.T @ edges for edges in np.moveaxis(displacements[self._count :], 2, 0)], axis=2)
        free = self._moves[: self._count]
        return QuadraticAnswer(at_corners[free], worked[free], (energies + energies.T) / 2)

    def product(self, displacement: Float64[np.ndarray, "nodes 3"]) -> Float64[np.ndarray, "nodes 3"]:
        """K u, N, on the corners and then on the edges; zero where they are held."""
        strain = np.stack([self._gradient @ component for component in np.ascontiguousarray(displacement.T)])
        strain = strain.reshape(3, 3, 4, -1)  # grad u at each corner of each tet
        stress = self._mu * (strain + strain.swapaxes(0, 1))
        pressure = self._lambda * (strain[0, 0] + strain[1, 1] + strain[2, 2])
        for axis in range(3):
            stress[axis, axis] += pressure
        stress = self._volumes / 20 * (stress + stress.sum(axis=2, keepdims=True))
        forces = np.stack([self._force_of_stress @ component for component in stress.reshape(3, -1)], axis=1)
        return np.where(self._moves, forces, 0.0)

    def _solved(self, linear: Answers, shape: Float64[np.ndarray, " dofs"], force: Float64[np.ndarray, " dofs"]) -> tuple[np.ndarray, np.ndarray]:
        """One answer, and K times it."""
        free = self._moves[: self._count]
        answer, load = np.zeros(self._moves.shape), np.zeros(self._moves.shape)
        answer[: self._count][free], load[: self._count][free] = shape, force
        load[self._count :] = np.where(self._moves[self._count :], self._spread @ load[: self._count], 0.0)
        left = load - self.product(answer)
        toward, before, gained = np.zeros_like(left), math.inf, 0.0
        for _ in range(MOST_ITERATIONS):
            step = np.concatenate([np.zeros(free.shape), np.einsum("eab,eb->ea", self._edge_answers, left[self._count :])])
            step[: self._count][free] = linear(left[: self._count][free][:, None])[:, 0]
            now = float((left * step).sum())
            toward = step + now / before * toward
            here, before = self.product(toward), now
            length = now / float((toward * here).sum())
            answer, left = answer + length * toward, left - length * here
            gained += length * now
            if length * now <= LAST_GAIN * gained:
                break
        return answer, load - left

    def _corner_gradients(self, mesh: TetMesh) -> csr_matrix:
        """From values at corners and edges to the gradient at each corner of each tet: rows are (direction, corner, tet)."""
        columns = np.empty((3, 4, len(mesh.tets), 7), dtype=np.int32)
        values, gradients = np.empty(columns.shape), self._gradients.transpose(2, 0, 1)
        for corner, (at, far) in enumerate(zip(EDGES_AT, FAR_ENDS, strict=True)):
            columns[:, corner, :, :4], columns[:, corner, :, 4:] = mesh.tets, self._count + self._edges[:, at]
            values[:, corner, :, :4], values[:, corner, :, 4:] = gradients, 4 * gradients[:, :, far]
        starts = np.arange(0, columns.size + 1, 7, dtype=np.int32)
        return csr_matrix((values.ravel(), columns.ravel(), starts), shape=(12 * len(mesh.tets), len(self._moves)))

    def _spreading(self, mesh: TetMesh) -> csr_matrix:
        """From forces on nodes to those on edges: the integral of 4 N_i N_j t with t = sum N_k t_k, which is V (t_1 + .. + t_4 + t_i + t_j) / 30.

        t_k is a node's force over its share of the volume.
        """
        shares = 1 / np.bincount(mesh.tets.ravel(), np.repeat(mesh.volumes / 4, 4))
        edges, nodes = np.repeat(self._edges[:, :, None], 4, axis=2), np.repeat(mesh.tets[:, None], 6, axis=1)
        is_end = (TET_EDGES[:, :, None] == np.arange(4)).any(axis=1)
        weights = mesh.volumes[:, None, None] / 30 * (1 + is_end) * shares[nodes]
        return csr_matrix((weights.ravel(), (edges.ravel(), nodes.ravel())), shape=(len(self.ends), self._count))

    def _inverse_edge_blocks(self) -> Float64[np.ndarray, "edges 3 3"]:
        """Of the 3 x 3 block of K of each edge: 16 times the integral of grad(N_i N_j) (x) grad(N_i N_j), held components left out."""
        whole, moves = np.zeros((len(self.ends), 9)), self._moves[self._count :]
        for edge, (first, second) in enumerate(TET_EDGES):
            one, other = self._gradients[:, first], self._gradients[:, second]
            mixed = one[:, :, None] * other[:, None]
            outer = 2 * (one[:, :, None] * one[:, None] + other[:, :, None] * other[:, None]) + mixed + mixed.swapaxes(1, 2)
            outer *= 16 / 20 * per_tet(self._volumes, 2)
            blocks = per_tet(self._lambda + self._mu, 2) * outer + per_tet(self._mu, 2) * np.trace(outer, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            for entry, values in enumerate(blocks.reshape(-1, 9).T):
                whole[:, entry] += np.bincount(self._edges[:, edge], values, minlength=len(self.ends))
        both = moves[:, :, None] & moves[:, None, :]
        return np.where(both, np.linalg.inv(np.where(both, whole.reshape(-1, 3, 3), np.eye(3) * ~moves[:, :, None])), 0.0)


def entries_beside_linear(model: ElasticModel) -> float:
    """How many times the matrix entries of linear tets quadratic ones have on a mesh.

    Two nodes share an entry when a tet holds both: (V + 2 E) pairs of corners, 2 (2 E + 3 F) of corner and edge, and
    E + 2 (3 F + 3 T) of edges, for V corners, E edges, F faces and T tets.
    """
    mesh = model.mesh
    nodes, edges, tets = len(mesh.nodes), len(mesh.edges[0]), len(mesh.tets)
    faces = (4 * tets + len(mesh.boundary_faces)) // 2
    return (nodes + 7 * edges + 12 * faces + 6 * tets) / (nodes + 2 * edges)
