"""Weight."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.simulate import simulate
from sdfnet.scene import Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
ELEMENTS = ("P1", "P1_nodal_pressure", "P2")


@pytest.fixture(scope="module", params=ELEMENTS)
def bar(request: pytest.FixtureRequest, make_box: MakeBox) -> ElasticModel:
    return assemble(make_box([0, 1, 2], [0, 1], [0, 1.5, 3]), Material(density=7.0), request.param)


def test_the_weight_is_mass_times_acceleration_and_the_stress_that_of_the_column(bar: ElasticModel) -> None:
    load = Gravity().load(bar)
    np.testing.assert_allclose(load.nodal_force.sum(axis=0), [0, 0, -9.81 * 7.0 * 6.0], rtol=1e-12, atol=1e-10)
    assert load.report["weight_N"] == pytest.approx(9.81 * 7.0 * 6.0, rel=1e-12)
    assert load.report["rho_g_length_Pa"] == pytest.approx(7.0 * 9.81 * 3.0, rel=1e-12)
    assert load.stress == load.report["rho_g_length_Pa"]


def test_the_length_is_measured_along_the_acceleration(bar: ElasticModel) -> None:
    assert Gravity((-4.0, 0.0, 0.0)).load(bar).stress == pytest.approx(7.0 * 4.0 * 2.0, rel=1e-12)


def test_it_is_the_body_force_of_the_density(bar: ElasticModel) -> None:
    np.testing.assert_array_equal(Gravity((1.0, 2.0, 3.0)).load(bar).nodal_force, BodyForce((7.0, 14.0, 21.0)).load(bar).nodal_force)


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_free_solid_falls_as_a_stone_does(make_box: MakeBox, element: str) -> None:
    mass = "consistent" if element == "P2" else "lumped"  # the lumped P2 mass takes other shares than the load, so that falling makes it quiver
    scene = Scene(Geometry(), {"weight": Gravity()}, Material(density=7.0), Recording(0.05, 3), Solver(element=element, mass=mass))
    fallen = simulate(scene, make_box([0, 1, 2], [0, 1], [0, 1.5, 3])).displacements[-1]
    np.testing.assert_allclose(fallen, np.broadcast_to([0, 0, -9.81 / 2 * 0.05**2], fallen.shape), rtol=1e-9, atol=1e-12)


def test_no_acceleration_is_no_load(bar: ElasticModel) -> None:
    load = Gravity((0.0, 0.0, 0.0)).load(bar)
    assert not load.nodal_force.any()
    assert load.stress == 0.0


def test_an_acceleration_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"gravity.acceleration must be finite, found \(0.0, 0.0, nan\) m/s\^2"):
        Gravity((0.0, 0.0, math.nan))
