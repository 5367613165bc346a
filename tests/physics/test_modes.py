"""Modes and the largest eigenvalue, sparse against dense."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.sparse import csr_matrix, diags

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.mass import ConsistentMass, LumpedMass, Mass, mass_of
from sdfnet.physics.modes import DENSE_SIZE, ShiftedStiffness, largest_eigenvalue, modes
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
STEEL = Material(youngs_modulus=2.1e11, poisson_ratio=0.29, density=7850.0)


@pytest.fixture(scope="module")
def model(make_box: MakeBox) -> ElasticModel:
    axis = np.linspace(0, 1, 6)
    return assemble(make_box(axis, axis, 2 * axis, jitter=0.2), STEEL)


def matrices(model: ElasticModel, is_held: bool, kind: str) -> tuple[csr_matrix, Mass]:
    fixed = np.repeat(model.elements.nodes[:, 2:] == 0, 3, axis=1) & is_held
    free = np.flatnonzero(~fixed.ravel())
    return model.stiffness[free][:, free], mass_of(kind, model, fixed)


@pytest.mark.parametrize("is_held", [True, False])
@pytest.mark.parametrize("kind", ["lumped", "consistent"])
def test_the_slowest_modes_are_those_of_the_dense_problem(model: ElasticModel, is_held: bool, kind: str) -> None:
    stiffness, mass = matrices(model, is_held, kind)
    assert stiffness.shape[0] > DENSE_SIZE  # the sparse way
    expected = eigh(stiffness.toarray(), mass.matrix().toarray(), subset_by_index=(0, 14), eigvals_only=True)
    found = modes(stiffness, mass, 15)
    rounding = 1e-8 if is_held else 1e-6  # the six zeros of a free solid leave rounding over the shift to the others
    np.testing.assert_allclose(found.angular_frequencies**2, expected, rtol=rounding, atol=1e-9 * expected[-1])
    np.testing.assert_array_equal(found.frequencies, found.angular_frequencies / (2 * np.pi))
    np.testing.assert_allclose(found.shapes.T @ mass.product(found.shapes), np.eye(15), atol=1e-8)
    residual = stiffness @ found.shapes - mass.product(found.shapes) * found.angular_frequencies**2
    assert np.abs(residual).max() < 100 * rounding * np.abs(stiffness @ found.shapes).max()


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
def test_a_free_solid_has_six_modes_of_frequency_zero(model: ElasticModel, kind: str) -> None:
    found = modes(*matrices(model, False, kind), 8).angular_frequencies
    assert found[5] < 1e-3 * found[6]  # the root of rounding, 1e-16 omega_max^2


def test_the_modes_do_not_change_from_call_to_call(model: ElasticModel) -> None:
    stiffness, mass = matrices(model, True, "lumped")
    np.testing.assert_array_equal(modes(stiffness, mass, 5).shapes, modes(stiffness, mass, 5).shapes)


@pytest.mark.parametrize("count", [0, 13])
def test_more_modes_than_unknowns_are_refused(count: int) -> None:
    single = assemble(TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])), STEEL)
    with pytest.raises(ConfigurationError, match=f"the number of modes must lie between 1 and the 12 free degrees of freedom, found {count}"):
        modes(*matrices(single, False, "lumped"), count)


def test_the_shift_is_regular_without_a_support_and_changes_no_elastic_answer(model: ElasticModel) -> None:
    for is_held in (True, False):
        stiffness, mass = matrices(model, is_held, "consistent")
        factor = ShiftedStiffness(stiffness, mass)
        values = np.random.default_rng(0).standard_normal((stiffness.shape[0], 2))
        force = stiffness @ values + factor.shift * mass.product(values)
        np.testing.assert_allclose(factor.solve(force), values, atol=1e-3 if not is_held else 1e-9)  # rigid motion of a free solid: rounding over the shift
    held, mass = matrices(model, True, "consistent")
    assert ShiftedStiffness(held, mass).shift < 1e-6 * modes(held, mass, 1).angular_frequencies[0] ** 2


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
def test_the_largest_eigenvalue_is_that_of_the_dense_problem(model: ElasticModel, kind: str) -> None:
    stiffness, mass = matrices(model, True, kind)
    expected = eigh(stiffness.toarray(), mass.matrix().toarray(), eigvals_only=True)[-1]
    if isinstance(mass, LumpedMass):
        root = diags(1 / np.sqrt(mass.diagonal))
        assert largest_eigenvalue(csr_matrix(root @ stiffness @ root), None) == pytest.approx(expected, rel=1e-7)
    else:
        assert isinstance(mass, ConsistentMass)
        assert largest_eigenvalue(stiffness, mass) == pytest.approx(expected, rel=1e-7)
