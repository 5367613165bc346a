"""Which nodes are held, and the refusals."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned

MakeBox = Callable[..., TetMesh]


@pytest.fixture(scope="module")
def box(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 2, 5), np.linspace(0, 1, 4), np.linspace(-1, 1, 5))


def test_by_default_the_boundary_nodes_on_or_under_the_floor_are_held(box: TetMesh) -> None:
    fixed = Pinned().fixed_components(box)
    expected = np.zeros(len(box.nodes), dtype=np.bool_)
    expected[box.surface_nodes] = box.nodes[box.surface_nodes, 2] <= 0
    assert expected.sum() < (box.nodes[:, 2] <= 0).sum()  # some node inside lies under the floor too and stays free
    np.testing.assert_array_equal(fixed, np.repeat(expected[:, None], 3, axis=1))


def test_a_plane_anywhere_can_hold_some_components_of_inner_nodes_too(box: TetMesh) -> None:
    fixed = Pinned(point=(0.5, 9.0, 9.0), normal=(3.0, 0.0, 0.0), components=(True, False, True), boundary_only=False).fixed_components(box)
    behind = box.nodes[:, 0] <= 0.5
    np.testing.assert_array_equal(fixed, np.stack([behind, np.zeros_like(behind), behind], axis=1))


def test_a_node_that_misses_the_plane_by_rounding_is_held(box: TetMesh) -> None:
    nudged = TetMesh(box.nodes + np.array([1e-12, 0.0, 0.0]), box.tets)
    wall = Pinned(normal=(1.0, 0.0, 0.0))
    np.testing.assert_array_equal(wall.fixed_components(nudged), wall.fixed_components(box))


def test_rollers_may_hold_one_component_of_every_node(box: TetMesh) -> None:
    fixed = Pinned(point=(0.0, 0.0, 5.0), components=(False, True, False), boundary_only=False).fixed_components(box)
    assert fixed[:, 1].all()
    assert not fixed[:, [0, 2]].any()


def test_holding_no_node_is_refused_with_the_heights(box: TetMesh) -> None:
    with pytest.raises(PhysicsError, match=r"at least one node, found none: heights .* run from 1 to 3 m; move pinned.point"):
        Pinned(point=(0.0, 0.0, -2.0)).fixed_components(box)


def test_holding_every_node_is_refused(box: TetMesh) -> None:
    with pytest.raises(PhysicsError, match=r"must leave a node free, found all \d+ held.*turn pinned.normal"):
        Pinned(point=(0.0, 0.0, 2.0)).fixed_components(box)


def test_a_zero_normal_and_no_component_are_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"pinned.normal must be finite and not zero, found \(0.0, 0.0, 0.0\)"):
        Pinned(normal=(0.0, 0.0, 0.0))
    with pytest.raises(ConfigurationError, match="must hold at least one of x, y, z, found none"):
        Pinned(components=(False, False, False))
