"""What follows the state, and the other element, in the terms of a reduced model."""

from collections.abc import Callable

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix, identity, kron, vstack

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.advice.reduced_model import Answers, ReducedLaw
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.roles import ForceLaw
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.elements import FiniteElements
from sdfnet.physics.mass import mass_of
from sdfnet.physics.modes import ShiftedStiffness
from sdfnet.physics.plan import Plan
from sdfnet.scene import Material

COUNTERPARTS = {"P1": "P1_nodal_pressure", "P1_nodal_pressure": "P1", "P2": "P1"}  # what each element is compared with
# The eight parts of a quadratic tet: one at each corner, four around the line between the middles of two opposite edges.
QUADRATIC_PARTS = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3], [4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]])


def contact(compiled: Plan, law: ForceLaw) -> ReducedLaw:
    """A force beside the elastic one."""
    free = np.flatnonzero(~compiled.fixed.ravel())
    return ReducedLaw(_force_on(free, compiled.fixed.size, law), law.stable_fraction, True, np.zeros(len(free)))


def finite_strain_excess(compiled: Plan, law: ForceLaw | None = None) -> ReducedLaw:
    """What finite strain, or another elastic law, adds to the linear force of linear tets: f(u) + K u.

    With quadratic elements the linear tets are the eight that its nodes cut each tet into.
    """
    free, linear = np.flatnonzero(~compiled.fixed.ravel()), linear_tets_on_all_nodes(compiled)
    elastic = FiniteStrain().elastic_law(linear) if law is None else law
    stiffness, whole = csr_matrix(linear.stiffness[free][:, free]), _force_on(free, compiled.fixed.size, elastic)
    return ReducedLaw(lambda displacement, time: whole(displacement, time) + stiffness @ displacement, elastic.stable_fraction, False, np.zeros(len(free)))


def _force_on(free: np.ndarray, size: int, law: ForceLaw) -> Callable[[np.ndarray, float], np.ndarray]:
    """A law's force on the free ones of so many degrees of freedom."""

    def force(displacement: np.ndarray, time: float) -> np.ndarray:
        nodal = np.zeros(size)
        nodal[free] = displacement
        result: np.ndarray = law.force(torch.from_numpy(nodal.reshape(-1, 3)), time).numpy().reshape(-1)[free]
        return result

    return force


def linear_tets(compiled: Plan) -> ElasticModel:
    """The scene's solid in P1 elements."""
    model = compiled.model
    return model if model.elements.element == "P1" else assemble(model.mesh, model.material, "P1")


def linear_tets_on_all_nodes(compiled: Plan) -> ElasticModel:
    """The scene's solid in P1 elements whose corners are the nodes of the scene's elements."""
    elements = compiled.model.elements
    if not elements.is_quadratic:
        return linear_tets(compiled)
    material = compiled.model.material
    of_parts = material if isinstance(material, Material) else material.of_parts(len(QUADRATIC_PARTS))
    return assemble(TetMesh(elements.nodes, elements.tets[:, QUADRATIC_PARTS].reshape(-1, 4)), of_parts, "P1")


def counterpart_element(compiled: Plan) -> tuple[csr_matrix, Answers, float]:
    """Stiffness on the free degrees of freedom and static answers of the element that the scene's is compared with, and the ratio of matrix entries.

    The linear tets beside quadratic ones are these with the middles of the edges held to the means of their ends: the
    matrix stays, and an answer is E K1^-1 E' f with E the interpolation.
    """
    model, free = compiled.model, np.flatnonzero(~compiled.fixed.ravel())
    if model.elements.is_quadratic:
        return _held_to_linear(compiled, free)
    other = assemble(model.mesh, model.material, COUNTERPARTS[model.elements.element])
    stiffness = csr_matrix(other.stiffness[free][:, free])
    factor = ShiftedStiffness(stiffness, mass_of("lumped", model, compiled.fixed))
    return stiffness, factor.solve, other.stiffness.nnz / model.stiffness.nnz


def _held_to_linear(compiled: Plan, free: np.ndarray) -> tuple[csr_matrix, Answers, float]:
    linear = linear_tets(compiled)
    corners = free[free < linear.elements.nodes.size]
    extension = csr_matrix(kron(_interpolation(compiled.model.elements), identity(3)))[free][:, corners]
    factor = ShiftedStiffness(csr_matrix(linear.stiffness[corners][:, corners]), mass_of("lumped", linear, compiled.fixed[: len(linear.elements.nodes)]))
    ratio = linear.stiffness.nnz / compiled.model.stiffness.nnz
    return csr_matrix(compiled.model.stiffness[free][:, free]), lambda forces: extension @ factor.solve(extension.T @ forces), ratio


def _interpolation(elements: FiniteElements) -> csr_matrix:
    """From values at the corners to values at all nodes: each middle of an edge is the mean of its ends."""
    count, middles = len(elements.mesh.nodes), len(elements.nodes) - len(elements.mesh.nodes)
    pairs = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
    ends = np.empty((middles, 2), dtype=np.int64)
    for local, pair in enumerate(pairs):
        ends[elements.tets[:, 4 + local] - count] = elements.tets[:, pair]
    means = coo_matrix((np.full(2 * middles, 0.5), (np.repeat(np.arange(middles), 2), ends.ravel())), shape=(middles, count))
    return csr_matrix(vstack([identity(count), means]))
