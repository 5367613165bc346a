"""Loads over time cut where they bend: what the methods that are exact in time take for straight."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import History, ramp
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
MakeEquation = Callable[..., EquationOfMotion]
EXACT = [name for name, kind in INTEGRATORS.items() if kind.is_exact_in_time]
ZIGZAG = History((0.1, 0.25, 0.3, 0.62), (0.3, 1.0, -1.0, 0.5))


@pytest.fixture(scope="module")
def model(make_box: MakeBox) -> ElasticModel:
    return assemble(make_box([0, 0.5, 1], [0, 1], [0, 0.5, 1]), Material())


@pytest.fixture(scope="module")
def equation(model: ElasticModel, make_equation: MakeEquation) -> Callable[[History | None], EquationOfMotion]:
    fixed = np.repeat(model.elements.nodes[:, 2:] == 0, 3, axis=1)
    force = np.random.default_rng(4).standard_normal((int((~fixed).sum()), 1))
    return lambda history: make_equation(model, fixed, force, history=history)


def ended(name: str, motion: EquationOfMotion, duration: float, steps: int) -> np.ndarray:
    """The displacement at the end, after so many steps, one by one."""
    integrator = INTEGRATORS[name](motion, duration / steps, **({"count": len(motion.free)} if name == "modal" else {}))
    state = integrator.initial_state()
    for _ in range(steps):
        integrator.advance(state, 1)
    return state.displacement.numpy()


def test_pieces_fill_the_span_and_are_the_history(equation: Callable[[History | None], EquationOfMotion]) -> None:
    time = 0.05
    for length, (first,), (last,) in equation(ZIGZAG).straight_pieces(time, 0.6):
        for share in (0.0, 0.3, 1.0):
            assert (1 - share) * first + share * last == pytest.approx(ZIGZAG.factor(time + share * length), abs=1e-13)
        time += length
    assert time == pytest.approx(0.65, rel=1e-15)
    assert [length for length, _, _ in equation(ZIGZAG).straight_pieces(0.7, 0.2)] == [0.2]


def test_the_pieces_of_a_regular_table_have_few_lengths(equation: Callable[[History | None], EquationOfMotion]) -> None:
    times = np.linspace(0.0, 1.0, 1001)
    pieces = list(equation(History(tuple(times.tolist()), tuple(np.sin(times).tolist()))).straight_pieces(0.0, 1.0))
    assert len(pieces) == 1000
    assert len({length for length, _, _ in pieces}) <= 3  # else each would take an exponential of its own


def test_a_rise_in_less_than_the_rounding_of_time_is_a_jump(equation: Callable[[History | None], EquationOfMotion]) -> None:
    for history in (ramp(1e-300), History((0.0, 5e-17, 2.0), (-1.0, 1.0, 1.0))):
        assert [(first, last) for _, first, last in equation(history).straight_pieces(0.0, 1.0)] == [([1.0], [1.0])]


@pytest.mark.parametrize("name", EXACT)
def test_a_sudden_rise_is_the_constant_load(equation: Callable[[History | None], EquationOfMotion], name: str) -> None:
    constant = ended(name, equation(None), 0.3, 2)
    np.testing.assert_allclose(ended(name, equation(ramp(1e-300)), 0.3, 2), constant, rtol=0, atol=1e-12 * np.abs(constant).max())


@pytest.mark.parametrize("name", EXACT)
def test_the_answer_does_not_depend_on_the_step(equation: Callable[[History | None], EquationOfMotion], name: str) -> None:
    fine = ended(name, equation(ZIGZAG), 1.0, 60)
    for steps in (1, 7):  # omega_max times the longest step is several hundred
        np.testing.assert_allclose(ended(name, equation(ZIGZAG), 1.0, steps), fine, rtol=0, atol=1e-11 * np.abs(fine).max())  # rounding times several hundred
