"""Few modes: what the static correction saves, and what is lost."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.integrators import Modal
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
MakeEquation = Callable[..., EquationOfMotion]
FEW = 12
SLOW = 2.0  # s: ten periods of the slowest mode, so that the fast ones follow the load at once


@pytest.fixture(scope="module")
def model(make_box: MakeBox) -> ElasticModel:
    axis = np.linspace(0, 1, 5)
    return assemble(make_box(axis, axis, axis, jitter=0.2), Material())


def pinched(model: ElasticModel, is_held: bool) -> tuple[np.ndarray, np.ndarray]:
    """The fixed components, and a force on two nodes that pinches them together: a load on a small patch."""
    fixed = np.repeat(model.elements.nodes[:, 2:] == 0, 3, axis=1) & is_held
    force = np.zeros(model.elements.nodes.shape)
    ends = [np.linalg.norm(model.elements.nodes - place, axis=1).argmin() for place in ([0.5, 0.5, 1.0], [0.5, 0.5, 0.5])]
    along = model.elements.nodes[ends[1]] - model.elements.nodes[ends[0]]  # or it would turn a free solid
    force[ends] = along, -along
    return fixed, force.reshape(-1, 1)[~fixed.ravel()]


def ended(motion: EquationOfMotion, count: int, duration: float = SLOW) -> np.ndarray:
    integrator = Modal(motion, duration, count)
    state = integrator.initial_state()
    integrator.advance(state, 1)
    return state.displacement.numpy()


@pytest.mark.parametrize("is_held", [True, False])
def test_a_slowly_rising_load_on_a_small_patch_needs_few_modes(model: ElasticModel, make_equation: MakeEquation, is_held: bool) -> None:
    fixed, force = pinched(model, is_held)
    motion = make_equation(model, fixed, force, history=ramp(SLOW))
    everything = ended(motion, len(motion.free))
    integrator = Modal(motion, SLOW, FEW)
    state = integrator.initial_state()
    integrator.advance(state, 1)
    modes_alone = integrator._shapes @ state.own["amplitude"].numpy()
    size = np.linalg.norm(everything)
    assert np.linalg.norm(state.displacement.numpy() - everything) < 0.01 * size
    assert np.linalg.norm(modes_alone - everything) > 0.3 * size  # they see little of a pinch


def test_the_centre_of_a_free_solid_moves_as_the_resultant_says(model: ElasticModel, make_equation: MakeEquation) -> None:
    force = np.zeros((model.elements.nodes.size, 1))
    force[3 * np.linalg.norm(model.elements.nodes - [0.5, 0.5, 1.0], axis=1).argmin() + 2] = -3.0
    motion, short = make_equation(model, np.zeros(model.elements.nodes.shape, dtype=np.bool_), force), 0.02
    moved = ended(motion, FEW, short).reshape(-1, 3)
    exact = np.array([0.0, 0.0, -0.5 * short**2 * 3.0 / model.lumped_mass.sum()])
    np.testing.assert_allclose(model.lumped_mass @ moved / model.lumped_mass.sum(), exact, atol=1e-6 * np.abs(exact).max())


def test_what_an_initial_state_has_outside_the_modes_is_lost(model: ElasticModel, make_equation: MakeEquation) -> None:
    fixed, force = pinched(model, is_held=True)
    integrator = Modal(make_equation(model, fixed, 0 * force, displacement=1e-3 * force), 1e-6, FEW)
    state = integrator.initial_state()
    np.testing.assert_array_equal(state.displacement.numpy(), 1e-3 * force)
    integrator.advance(state, 1)
    assert 0 < np.linalg.norm(state.displacement.numpy()) < 0.5 * np.linalg.norm(1e-3 * force)


def test_more_modes_than_there_are_means_all(model: ElasticModel, make_equation: MakeEquation) -> None:
    motion = make_equation(model, *pinched(model, is_held=True), history=ramp(SLOW))
    np.testing.assert_array_equal(ended(motion, 10 * len(motion.free)), ended(motion, len(motion.free)))
