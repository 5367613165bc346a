"""The steps of symplectic Euler and leapfrog against the formula written out with dense matrices."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.integrators import Leapfrog, SymplecticEuler
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
MakeEquation = Callable[..., EquationOfMotion]
STEPS = 40


@pytest.fixture(scope="module")
def model(make_box: MakeBox) -> ElasticModel:
    return assemble(make_box(np.linspace(0, 1, 4), np.linspace(0, 1, 3), np.linspace(0, 2, 4), jitter=0.2), Material())


@pytest.fixture(scope="module")
def fixed(model: ElasticModel) -> np.ndarray:
    """A foot that slides along x: the components have different free nodes."""
    held = np.zeros((len(model.mesh.nodes), 3), dtype=np.bool_)
    held[model.mesh.nodes[:, 2] == 0, 1:] = True
    return held


def stepped(motion: EquationOfMotion, scheme: type[Leapfrog] | type[SymplecticEuler], time_step: float) -> tuple[np.ndarray, np.ndarray]:
    integrator = scheme(motion, time_step)
    state = integrator.initial_state()
    integrator.advance(state, STEPS // 2)
    integrator.advance(state, STEPS - STEPS // 2)
    return state.displacement.numpy(), state.velocity.numpy()


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", [SymplecticEuler, Leapfrog])
def test_velocity_is_kicked_first_and_position_follows_with_the_new_velocity(
    model: ElasticModel, fixed: np.ndarray, make_equation: MakeEquation, kind: str, scheme: type[Leapfrog] | type[SymplecticEuler]
) -> None:
    free = np.flatnonzero(~fixed.ravel())
    force = np.random.default_rng(1).standard_normal((len(free), 2))
    scalar = np.diag(model.lumped_mass) if kind == "lumped" else model.consistent_mass.toarray()
    inverse_mass = np.linalg.inv(np.kron(scalar, np.eye(3))[np.ix_(free, free)])
    stiffness, h = model.stiffness.toarray()[np.ix_(free, free)], 5e-4
    u = np.zeros_like(force)
    v = np.zeros_like(force) if scheme is SymplecticEuler else -h / 2 * inverse_mass @ force
    for _ in range(STEPS):
        v = v + h * inverse_mass @ (force - stiffness @ u)
        u = u + h * v
    displacement, velocity = stepped(make_equation(model, fixed, force, kind), scheme, h)
    np.testing.assert_allclose(displacement, u, atol=1e-11 * np.abs(u).max())  # rounding over 40 steps
    np.testing.assert_allclose(velocity, v, atol=1e-11 * np.abs(v).max())


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
def test_load_cases_side_by_side_move_as_each_does_alone(model: ElasticModel, fixed: np.ndarray, make_equation: MakeEquation, kind: str) -> None:
    force = np.random.default_rng(2).standard_normal((int((~fixed).sum()), 3))
    together, _ = stepped(make_equation(model, fixed, force, kind), Leapfrog, 5e-4)
    for column in range(3):
        alone, _ = stepped(make_equation(model, fixed, force[:, column : column + 1], kind), Leapfrog, 5e-4)
        np.testing.assert_allclose(together[:, column : column + 1], alone, atol=1e-12 * np.abs(alone).max())
