"""Solids that are let go in motion."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.regions import BoxRegion, HalfSpace
from sdfnet.physics.simulate import simulate
from sdfnet.scene import Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
ELEMENTS = ("P1", "P1_nodal_pressure", "P2")


@pytest.fixture(scope="module", params=ELEMENTS)
def bar(request: pytest.FixtureRequest, make_box: MakeBox) -> ElasticModel:
    return assemble(make_box([0, 0.5, 2], [0, 1], [0, 1]), Material(), request.param)


def test_all_nodes_move_alike_by_default_and_none_is_displaced(bar: ElasticModel) -> None:
    start = InitialMotion(velocity=(1.0, -2.0, 3.0)).start(bar)
    np.testing.assert_array_equal(start.velocity, np.broadcast_to([1.0, -2.0, 3.0], start.velocity.shape))
    assert not start.displacement.any()


def test_a_turn_about_a_point_is_right_handed(bar: ElasticModel) -> None:
    start = InitialMotion(angular_velocity=(0.0, 0.0, 2.0), center=(0.0, 0.0, 0.0)).start(bar)
    x, y, _ = bar.elements.nodes.T
    np.testing.assert_allclose(start.velocity, np.stack([-2 * y, 2 * x, 0 * x], axis=1), rtol=1e-15)


def test_without_a_point_it_turns_about_the_centre_of_mass_and_has_no_momentum(bar: ElasticModel) -> None:
    velocity = InitialMotion(angular_velocity=(1.0, 2.0, 3.0)).start(bar).velocity
    np.testing.assert_allclose(bar.lumped_mass @ velocity, 0, atol=1e-14 * bar.lumped_mass.sum())
    np.testing.assert_allclose(velocity, np.cross([1.0, 2.0, 3.0], bar.elements.nodes - [1.0, 0.5, 0.5]), atol=1e-14)


def test_only_nodes_in_the_region_move(bar: ElasticModel) -> None:
    velocity = InitialMotion(velocity=(1.0, 0.0, 0.0), region=BoxRegion(upper=(0.5, 9.0, 9.0))).start(bar).velocity
    np.testing.assert_array_equal(velocity[:, 0] == 1.0, bar.elements.nodes[:, 0] <= 0.5)


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_thrown_solid_flies_on_without_deforming(make_box: MakeBox, element: str) -> None:
    scene = Scene(Geometry(), {"throw": InitialMotion(velocity=(0.0, 2.0, 0.0))}, recording=Recording(0.05, 3), solver=Solver(element=element))
    flown = simulate(scene, make_box([0, 1, 2], [0, 1], [0, 1])).displacements[-1]
    np.testing.assert_allclose(flown, np.broadcast_to([0.0, 0.1, 0.0], flown.shape), atol=1e-13)


def test_a_region_that_holds_no_node_is_refused_with_its_distance(bar: ElasticModel) -> None:
    with pytest.raises(PhysicsError, match="must move at least one node, found none: HalfSpace.* its nearest node 1 m away; move or enlarge initial_motion"):
        InitialMotion(velocity=(1.0, 0.0, 0.0), region=HalfSpace(point=(0.0, 0.0, -1.0))).start(bar)


@pytest.mark.parametrize("name", ["velocity", "angular_velocity", "center"])
def test_settings_that_are_not_finite_are_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match=f"initial_motion.{name} must be finite"):
        InitialMotion(**{name: (0.0, math.nan, 0.0)})  # type: ignore[arg-type]
