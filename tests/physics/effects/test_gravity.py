"""Weight."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.inclusion import Inclusion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import BoxRegion
from sdfnet.physics.simulate import simulate
from sdfnet.physics.statics import static_solution
from sdfnet.scene import SOLVER_CHOICES, Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
ELEMENTS, MASSES = ("P1", "P1_nodal_pressure", "P2"), ("lumped", "consistent")


@pytest.fixture(scope="module", params=[(element, mass) for element in ELEMENTS for mass in MASSES])
def bar(request: pytest.FixtureRequest, make_box: MakeBox) -> ElasticModel:
    return assemble(make_box([0, 1, 2], [0, 1], [0, 1.5, 3]), Material(density=7.0), *request.param)


def test_the_weight_is_mass_times_acceleration_and_the_stress_that_of_the_column(bar: ElasticModel) -> None:
    load = Gravity().load(bar)
    np.testing.assert_allclose(load.nodal_force.sum(axis=0), [0, 0, -9.81 * 7.0 * 6.0], rtol=1e-12, atol=1e-10)
    assert load.report["weight_N"] == pytest.approx(9.81 * 7.0 * 6.0, rel=1e-12)
    assert load.report["rho_g_length_Pa"] == pytest.approx(7.0 * 9.81 * 3.0, rel=1e-12)
    assert load.stress == load.report["rho_g_length_Pa"]


def test_the_length_is_measured_along_the_acceleration(bar: ElasticModel) -> None:
    assert Gravity((-4.0, 0.0, 0.0)).load(bar).stress == pytest.approx(7.0 * 4.0 * 2.0, rel=1e-12)


def test_it_is_the_mass_that_weighs_times_the_acceleration(bar: ElasticModel) -> None:
    mass = np.diag(bar.lumped_mass) if bar.weight_mass == "lumped" else bar.consistent_mass.toarray()
    expected = mass @ np.broadcast_to([1.0, 2.0, 3.0], bar.elements.nodes.shape)
    np.testing.assert_allclose(Gravity((1.0, 2.0, 3.0)).load(bar).nodal_force, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def test_it_is_the_body_force_of_the_density_but_for_lumped_quadratic_tets(bar: ElasticModel) -> None:
    weight, expected = Gravity((1.0, 2.0, 3.0)).load(bar).nodal_force, BodyForce((7.0, 14.0, 21.0)).load(bar).nodal_force
    apart = float(np.abs(weight - expected).max() / np.abs(expected).max())
    assert apart > 0.1 if bar.elements.is_quadratic and bar.weight_mass == "lumped" else apart < 1e-13


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_each_tet_weighs_by_its_own_density(make_box: MakeBox, element: str) -> None:
    cube, heavy = make_box([0, 1, 2], [0, 1], [0, 1]), BoxRegion(lower=(1.0, -1.0, -1.0))
    scene = Scene(Geometry(), {"weight": Gravity(), "core": Inclusion(heavy, Material(density=100.0))}, Material(density=7.0), solver=Solver(element=element))
    compiled = plan(scene, cube)
    assert compiled.report["weight_weight_N"] == pytest.approx(9.81 * 107.0, rel=1e-12)


@pytest.mark.parametrize("integrator", SOLVER_CHOICES["integrator"])
def test_a_free_solid_of_lumped_quadratic_tets_falls_as_a_stone_does(make_box: MakeBox, integrator: str) -> None:
    solver = Solver(integrator, "lumped", "P2", modes=1000)
    scene = Scene(Geometry(), {"weight": Gravity()}, Material(density=7.0), Recording(0.05, 3), solver)
    trajectory = simulate(scene, make_box([0, 1, 2], [0, 1], [0, 1.5, 3]))
    fallen, ahead = trajectory.displacements[-1], trajectory.time_step if integrator == "symplectic_euler" else 0.0
    np.testing.assert_allclose(fallen, np.broadcast_to([0, 0, -9.81 / 2 * 0.05 * (0.05 + ahead)], fallen.shape), rtol=1e-9, atol=1e-10)


def test_a_held_solid_of_lumped_quadratic_tets_swings_about_the_sag_of_the_body_force(make_box: MakeBox) -> None:
    column, material = make_box([0, 1], [0, 1], [0, 1.5, 3]), Material(density=7.0)
    density = BodyForce((0.0, 0.0, -9.81 * 7.0))
    by_mass = Scene(Geometry(), {"foot": Pinned(), "weight": Gravity()}, material, Recording(0.05, 3), Solver("exact", element="P2"))
    by_volume = replace(by_mass, effects={"foot": Pinned(), "weight": density})
    sag = static_solution(plan(by_volume, column))
    np.testing.assert_allclose(static_solution(plan(by_mass, column)), sag, rtol=0, atol=1e-11 * np.abs(sag).max())
    swung = simulate(by_volume, column).displacements
    np.testing.assert_allclose(simulate(by_mass, column).displacements, swung, rtol=0, atol=1e-10 * np.abs(swung).max())


def test_no_acceleration_is_no_load(bar: ElasticModel) -> None:
    load = Gravity((0.0, 0.0, 0.0)).load(bar)
    assert not load.nodal_force.any()
    assert load.stress == 0.0


def test_an_acceleration_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"gravity.acceleration must be finite, found \(0.0, 0.0, nan\) m/s\^2"):
        Gravity((0.0, 0.0, math.nan))
