"""Tractions and pressures on parts of the surface."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from jaxtyping import Bool, Float64

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.traction import Traction
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.regions import Ball, BoxRegion, HalfSpace, Region
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
RIGHT = HalfSpace(point=(2.0, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))


@pytest.fixture(scope="module", params=["P1", "P1_nodal_pressure", "P2"])
def bar(request: pytest.FixtureRequest, make_box: MakeBox) -> ElasticModel:
    return assemble(make_box(np.linspace(0, 2, 5), np.linspace(0, 1, 4), np.linspace(0, 1, 3)), Material(), request.param)


def test_a_pulled_end_carries_traction_times_area_and_nothing_else_is_loaded(bar: ElasticModel) -> None:
    load = Traction(RIGHT, traction=(3.0, 0.0, -4.0)).load(bar)
    np.testing.assert_allclose(load.nodal_force.sum(axis=0), [3.0, 0.0, -4.0], rtol=1e-12, atol=1e-14)
    assert not load.nodal_force[bar.elements.nodes[:, 0] < 2].any()
    assert load.report["loaded_area_m2"] == pytest.approx(1.0, rel=1e-12)
    assert load.report["resultant_N"] == pytest.approx(5.0, rel=1e-12)
    assert load.stress == 5.0


def test_a_face_that_misses_the_region_by_rounding_is_loaded(bar: ElasticModel) -> None:
    beyond = HalfSpace(point=(2.0 + 1e-12, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))
    np.testing.assert_array_equal(Traction(beyond, pressure=1.0).load(bar).nodal_force, Traction(RIGHT, pressure=1.0).load(bar).nodal_force)


def test_a_pressure_pushes_against_the_outward_normal(bar: ElasticModel) -> None:
    force = Traction(RIGHT, pressure=7.0).load(bar).nodal_force.sum(axis=0)
    np.testing.assert_allclose(force, [-7.0, 0.0, 0.0], rtol=1e-12, atol=1e-14)


def test_traction_and_pressure_add_up(bar: ElasticModel) -> None:
    both = Traction(RIGHT, traction=(0.0, 3.0, 0.0), pressure=7.0).load(bar)
    parts = [Traction(RIGHT, traction=(0.0, 3.0, 0.0)).load(bar), Traction(RIGHT, pressure=7.0).load(bar)]
    np.testing.assert_array_equal(both.nodal_force, parts[0].nodal_force + parts[1].nodal_force)
    assert both.stress == 10.0


def test_a_pressure_all_around_has_no_resultant_and_no_moment(bar: ElasticModel) -> None:
    load = Traction(pressure=7.0).load(bar)
    assert load.report["loaded_area_m2"] == pytest.approx(10.0, rel=1e-12)
    np.testing.assert_allclose(load.nodal_force.sum(axis=0), 0, atol=1e-12)  # of forces of about 1 N
    np.testing.assert_allclose(np.cross(bar.elements.nodes, load.nodal_force).sum(axis=0), 0, atol=1e-12)


def test_a_region_may_end_within_a_face(bar: ElasticModel) -> None:
    load = Traction(BoxRegion(lower=(2.0, -1.0, -1.0), upper=(3.0, 0.6, 0.9)), traction=(1.0, 0.0, 0.0)).load(bar)
    assert load.report["loaded_area_m2"] == pytest.approx(0.54, rel=0.01)  # the edges of a step function between quadrature points


def test_a_small_ball_on_large_faces_loads_its_disc(bar: ElasticModel) -> None:
    load = Traction(Ball(center=(0.9, 0.55, 1.0), radius=0.2), pressure=1.0).load(bar)
    np.testing.assert_allclose(load.nodal_force.sum(axis=0), [0, 0, -math.pi * 0.04], rtol=0.02, atol=1e-12)  # faces of 0.6, quadrature points every 0.02


@dataclass(frozen=True)
class Spot(Region):
    """As a user would write one, with no thought of a tolerance: much smaller than a face and far from its middle."""

    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        near: np.ndarray = np.linalg.norm(points - [0.55, 0.38, 1.0], axis=1) <= 0.04
        return near


def test_a_predicate_of_ones_own_loads_what_it_holds(bar: ElasticModel) -> None:
    expected = Traction(Ball(center=(0.55, 0.38, 1.0), radius=0.04), pressure=1.0).load(bar)
    assert float(expected.report["loaded_area_m2"]) > 0.004
    np.testing.assert_array_equal(Traction(Spot(), pressure=1.0).load(bar).nodal_force, expected.nodal_force)


def test_a_region_that_misses_the_surface_is_refused_with_its_distance(bar: ElasticModel) -> None:
    message = r"load some of the surface, found none: Ball\(.* and a solid from .* its nearest node 0.5 m away; move or enlarge traction.region"
    with pytest.raises(PhysicsError, match=message):
        Traction(Ball(center=(3.0, 1.0, 1.0), radius=0.5), pressure=1.0).load(bar)


def test_nothing_loads_nothing(bar: ElasticModel) -> None:
    load = Traction(RIGHT).load(bar)
    assert not load.nodal_force.any()
    assert load.report["loaded_area_m2"] == pytest.approx(1.0, rel=1e-12)


def test_settings_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="traction.pressure must be finite, found nan Pa"):
        Traction(pressure=math.nan)
    with pytest.raises(ConfigurationError, match=r"traction.traction must be finite, found \(inf, 0.0, 0.0\) Pa"):
        Traction(traction=(math.inf, 0.0, 0.0))
