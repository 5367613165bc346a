"""The mass of the free degrees of freedom: multiplied by, and solved with."""

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csr_matrix, diags, eye, kron
from scipy.sparse.linalg import splu

from sdfnet.physics.elasticity import ElasticModel


class Mass(ABC):
    """M of the equation of motion, restricted to the free degrees of freedom (kg)."""

    @abstractmethod
    def product(self, values: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
        """M x."""

    @abstractmethod
    def solve(self, values: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
        """M^-1 x."""

    @abstractmethod
    def matrix(self) -> csr_matrix:
        """M itself."""


class LumpedMass(Mass):
    """Each node's mass at the node: diagonal, nothing to solve."""

    def __init__(self, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> None:
        self.diagonal = np.repeat(model.lumped_mass, 3)[~fixed.ravel()]

    def product(self, values: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
        """M x."""
        result: np.ndarray = self.diagonal[:, None] * values
        return result

    def solve(self, values: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
        """M^-1 x."""
        result: np.ndarray = values / self.diagonal[:, None]
        return result

    def matrix(self) -> csr_matrix:
        """M itself."""
        return csr_matrix(diags(self.diagonal))


class ConsistentMass(Mass):
    """The paper's Galerkin mass: one factor of the scalar matrix for all components whose free nodes are the same.

    A solve costs about as much as a product with the stiffness matrix; its stable step is smaller than the lumped one.
    """

    def __init__(self, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> None:
        free = np.flatnonzero(~fixed.ravel())
        self._matrix = csr_matrix(kron(model.consistent_mass, eye(3)))[free][:, free]
        position = np.cumsum(~fixed.ravel()).reshape(fixed.shape) - 1  # of a free (node, component) among the free degrees of freedom
        self._blocks = []
        for pattern in np.unique(fixed, axis=1).T:  # each distinct set of fixed nodes
            components = np.flatnonzero((fixed == pattern[:, None]).all(axis=0))
            nodes = np.flatnonzero(~pattern)
            if len(nodes) == 0:
                continue
            matrix = model.consistent_mass[nodes][:, nodes].tocsc()
            factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
            self._blocks.append((position[np.ix_(nodes, components)], matrix, factor))

    def product(self, values: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
        """M x."""
        result = np.empty_like(values)
        for index, matrix, _ in self._blocks:
            part = values[index]
            result[index] = (matrix @ part.reshape(len(index), -1)).reshape(part.shape)
        return result

    def solve(self, values: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
        """M^-1 x by the sparse factor."""
        result = np.empty_like(values)
        for index, _, factor in self._blocks:
            part = values[index]
            result[index] = factor.solve(part.reshape(len(index), -1)).reshape(part.shape)
        return result

    def matrix(self) -> csr_matrix:
        """M itself."""
        return self._matrix


def mass_of(kind: str, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> Mass:
    """The mass that `solver.mass` names: lumped or consistent."""
    return LumpedMass(model, fixed) if kind == "lumped" else ConsistentMass(model, fixed)
