"""Which nodes are held, and the refusals."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.elasticity import finite_elements
from sdfnet.physics.elements import FiniteElements
from sdfnet.physics.regions import Ball, HalfSpace

MakeBox = Callable[..., TetMesh]


@pytest.fixture(scope="module")
def box(make_box: MakeBox) -> FiniteElements:
    return finite_elements(make_box(np.linspace(0, 2, 5), np.linspace(0, 1, 4), np.linspace(-1, 1, 5)))


def test_by_default_the_boundary_nodes_on_or_under_the_floor_are_held(box: FiniteElements) -> None:
    fixed = Pinned().fixed_components(box)
    expected = np.zeros(len(box.nodes), dtype=np.bool_)
    expected[box.mesh.surface_nodes] = box.nodes[box.mesh.surface_nodes, 2] <= 0
    assert expected.sum() < (box.nodes[:, 2] <= 0).sum()  # some node inside lies under the floor too and stays free
    np.testing.assert_array_equal(fixed, np.repeat(expected[:, None], 3, axis=1))


def test_a_plane_anywhere_can_hold_some_components_of_inner_nodes_too(box: FiniteElements) -> None:
    wall = Pinned(HalfSpace(point=(0.5, 9.0, 9.0), normal=(3.0, 0.0, 0.0)), components=(True, False, True), boundary_only=False)
    fixed = wall.fixed_components(box)
    behind = box.nodes[:, 0] <= 0.5
    np.testing.assert_array_equal(fixed, np.stack([behind, np.zeros_like(behind), behind], axis=1))


def test_a_node_that_misses_the_plane_by_rounding_is_held(box: FiniteElements) -> None:
    nudged = finite_elements(TetMesh(box.nodes + np.array([1e-12, 0.0, 0.0]), box.tets))
    wall = Pinned(HalfSpace(normal=(1.0, 0.0, 0.0)))
    np.testing.assert_array_equal(wall.fixed_components(nudged), wall.fixed_components(box))


def test_rollers_may_hold_one_component_of_every_node(box: FiniteElements) -> None:
    fixed = Pinned(HalfSpace(point=(0.0, 0.0, 5.0)), components=(False, True, False), boundary_only=False).fixed_components(box)
    assert fixed[:, 1].all()
    assert not fixed[:, [0, 2]].any()


def test_quadratic_elements_are_held_at_the_middles_of_edges_too(box: FiniteElements) -> None:
    quadratic = finite_elements(box.mesh, "P2")
    fixed = Pinned().fixed_components(quadratic)
    np.testing.assert_array_equal(fixed[: len(box.nodes)], Pinned().fixed_components(box))
    middles = quadratic.nodes[len(box.nodes) :]
    on_faces = np.isclose(middles, [2.0, 1.0, 1.0]).any(axis=1) | np.isclose(middles, [0.0, 0.0, -1.0]).any(axis=1)
    np.testing.assert_array_equal(fixed[len(box.nodes) :].all(axis=1), on_faces & (middles[:, 2] <= 0))


def test_a_ball_holds_the_nodes_within_its_radius(box: FiniteElements) -> None:
    fixed = Pinned(Ball(center=(2.0, 1.0, 1.0), radius=0.6)).fixed_components(box)
    np.testing.assert_array_equal(fixed.all(axis=1), np.linalg.norm(box.nodes - [2.0, 1.0, 1.0], axis=1) <= 0.6)
    assert fixed.all(axis=1).sum() == 4


def test_holding_no_node_is_refused_with_the_solid_and_its_distance(box: FiniteElements) -> None:
    message = r"at least one node, found none: HalfSpace.* a solid from \(0.0, 0.0, -1.0\) to \(2.0, 1.0, 1.0\) m, its nearest node 1 m away; move or enlarge"
    with pytest.raises(PhysicsError, match=message):
        Pinned(HalfSpace(point=(0.0, 0.0, -2.0))).fixed_components(box)


def test_holding_every_node_is_refused(box: FiniteElements) -> None:
    with pytest.raises(PhysicsError, match=r"must leave a node free, found all \d+ held.*turn pinned.region"):
        Pinned(HalfSpace(point=(0.0, 0.0, 2.0))).fixed_components(box)


def test_a_zero_normal_and_no_component_are_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"region.normal must be finite and not zero, found \(0.0, 0.0, 0.0\)"):
        Pinned(HalfSpace(normal=(0.0, 0.0, 0.0)))
    with pytest.raises(ConfigurationError, match="must hold at least one of x, y, z, found none"):
        Pinned(components=(False, False, False))
