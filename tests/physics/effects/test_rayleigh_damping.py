"""The two coefficients, and the decay that they cause."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import NodalStart
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.effects.roles import Damping
from sdfnet.physics.elasticity import assemble
from sdfnet.physics.mass import LumpedMass
from sdfnet.physics.modes import modes
from sdfnet.physics.simulate import simulate
from sdfnet.scene import Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]


@pytest.mark.parametrize("ratios", [(0.02, 0.05), (0.05, 0.02), (0.0, 0.0)])
@pytest.mark.parametrize("frequencies", [(10.0, 40.0), (40.0, 10.0)])
def test_both_ratios_are_met_at_their_frequencies(ratios: tuple[float, float], frequencies: tuple[float, float]) -> None:
    if frequencies[0] > frequencies[1]:
        ratios = (ratios[1], ratios[0])
    effect = RayleighDamping.from_ratios(ratios, frequencies)
    for ratio, frequency in zip(ratios, frequencies, strict=True):
        w = 2 * math.pi * frequency
        assert (effect.mass / w + effect.stiffness * w) / 2 == pytest.approx(ratio, rel=1e-12, abs=1e-15)


def test_numbers_of_numpy_are_taken_as_natural_frequencies_are() -> None:
    first, third = np.array([10.0, 40.0])
    effect = RayleighDamping.from_ratios((0.02, 0.02), (first, third))
    assert [bool(Damping(effect.mass, effect.stiffness)), bool(Damping(0 * first, 0 * third))] == [True, False]


def test_a_mode_decays_with_its_ratio(make_box: MakeBox) -> None:
    mesh, material, ratio = make_box([0, 1, 2], [0, 0.7], [0, 1]), Material(), 0.03
    model = assemble(mesh, material)
    found = modes(model.stiffness, LumpedMass(model, np.zeros_like(mesh.nodes, dtype=np.bool_)), 8)
    frequency, shape = float(found.frequencies[7]), found.shapes[:, 7].reshape(-1, 3)
    periods, recording = 4, Recording(4 / frequency, 2)
    damping = RayleighDamping.from_ratios((ratio, ratio), (frequency, 3 * frequency))
    solver = Solver("newmark", time_step=1 / (200 * frequency))
    scene = Scene(Geometry(), {"pluck": NodalStart(1e-3 * shape), "damping": damping}, material, recording, solver)
    left = float((simulate(scene, mesh).displacements[-1] * shape).sum() / (1e-3 * (shape**2).sum()))
    # At whole periods of the undamped mode. The damped one is late by x^2 / 2 of its phase of 8 pi, which takes 4e-4 of its height.
    assert left == pytest.approx(math.exp(-ratio * 2 * math.pi * periods), rel=1e-3)


@pytest.mark.parametrize(
    ("ratios", "frequencies", "message"),
    [
        ((0.1, 0.01), (10.0, 20.0), r"need mass .* and stiffness -.* choose the second ratio between 0.05 and 0.2"),
        ((0.01, 0.1), (10.0, 20.0), r"need mass -.* choose the second ratio between 0.005 and 0.02"),
        ((0.1, 0.1), (10.0, 10.0), r"frequencies must be positive and not equal, found \(10.0, 10.0\) Hz"),
        ((0.1, 0.1), (0.0, 10.0), "frequencies must be positive and not equal"),
        ((-0.1, 0.1), (5.0, 10.0), "damping ratios must be finite and not negative"),
        ((math.nan, 0.1), (5.0, 10.0), "damping ratios must be finite and not negative"),
    ],
)
def test_ratios_that_no_two_coefficients_give_are_refused(ratios: tuple[float, float], frequencies: tuple[float, float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        RayleighDamping.from_ratios(ratios, frequencies)


@pytest.mark.parametrize("settings", [{"mass": -1.0}, {"stiffness": -1.0}, {"mass": math.nan}, {"stiffness": math.inf}])
def test_coefficients_that_would_feed_the_motion_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match=f"rayleigh_damping.{next(iter(settings))} must be finite and not negative"):
        RayleighDamping(**settings)
