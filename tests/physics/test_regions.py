"""Which points lie in a region, and what is said where none does."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from jaxtyping import Bool, Float64

from sdfnet.errors import ConfigurationError
from sdfnet.physics.regions import REGIONS, Ball, BoxRegion, HalfSpace, Region, Where

POINTS = np.random.default_rng(5).uniform(-2, 2, (500, 3))
SAMPLES = [
    HalfSpace(point=(0.3, 0.0, -0.2), normal=(1.0, 2.0, -2.0)),
    BoxRegion(lower=(-1.0, -0.5, -np.inf), upper=(0.5, np.inf, 1.0)),
    Ball(center=(0.2, 0.1, -0.3), radius=1.2),
]


def test_a_half_space_holds_what_is_behind_its_plane() -> None:
    expected = (POINTS - [0.3, 0.0, -0.2]) @ [1.0, 2.0, -2.0] <= 0
    np.testing.assert_array_equal(SAMPLES[0].contains(POINTS), expected)
    assert 0 < expected.sum() < 500


def test_a_box_holds_what_is_between_its_corners() -> None:
    x, y, z = POINTS.T
    np.testing.assert_array_equal(SAMPLES[1].contains(POINTS), (x >= -1) & (x <= 0.5) & (y >= -0.5) & (z <= 1))


def test_a_ball_holds_what_is_near_its_centre() -> None:
    np.testing.assert_array_equal(SAMPLES[2].contains(POINTS), np.linalg.norm(POINTS - [0.2, 0.1, -0.3], axis=1) <= 1.2)


def test_by_default_a_box_is_all_of_space() -> None:
    assert BoxRegion().contains(1e300 * POINTS).all()


@pytest.mark.parametrize("region", SAMPLES, ids=lambda region: type(region).__name__)
def test_the_faces_belong_to_a_region_and_a_tolerance_is_a_length(region: Region) -> None:
    outside = {"HalfSpace": (0.3 + 0.1, 0.2, -0.2 - 0.2), "BoxRegion": (0.5 + 0.3, 0.0, 0.0), "Ball": (0.2, 0.1, -0.3 + 1.5)}[type(region).__name__]
    point = np.array([outside])  # 0.3 out of it
    assert not region.contains(point, 0.3 - 1e-12).any()
    assert region.contains(point, 0.3 + 1e-12).all()


@pytest.mark.parametrize("region", SAMPLES, ids=lambda region: type(region).__name__)
def test_what_may_reach_a_region_is_never_missed(region: Region) -> None:
    near = region.may_reach(POINTS, 0.5)
    for offset in 0.5 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]):
        assert near[region.contains(POINTS + offset)].all()
    assert not near.all()


@dataclass(frozen=True)
class Slab(Region):
    """As a user would write one, with no thought of a tolerance."""

    height: float = 0.0

    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        above: np.ndarray = points[:, 2] > self.height
        return above


def test_a_predicate_of_ones_own_may_reach_everything_unless_it_says_otherwise() -> None:
    assert Slab(height=1.0).may_reach(POINTS, 0.0).all()


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (HalfSpace(point=(0.0, 0.0, -2.5)), "its nearest node 1.5 m away"),
        (BoxRegion(lower=(3.25, -1.0, -1.0)), "its nearest node 2.25 m away"),
        (Ball(center=(0.0, 0.0, 1000.0), radius=1.0), "its nearest node 998 m away"),
    ],
)
def test_a_region_beside_a_solid_says_how_far(region: Region, message: str) -> None:
    corners = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T
    axis = np.array([[0.0, 0.0, 1.0]])
    assert region.beside(np.concatenate([corners, axis])) == f"{region} and a solid from (-1.0, -1.0, -1.0) to (1.0, 1.0, 1.0) m, {message}"


def test_without_a_tolerance_or_a_distance_only_the_places_are_said() -> None:
    assert Slab(height=9.0).beside(np.eye(3)) == "Slab(height=9.0) and a solid from (0.0, 0.0, 0.0) to (1.0, 1.0, 1.0) m"
    assert BoxRegion().beside(np.eye(3)).endswith("to (1.0, 1.0, 1.0) m")


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (HalfSpace, {"normal": (0.0, 0.0, 0.0)}, r"region.normal must be finite and not zero, found \(0.0, 0.0, 0.0\)"),
        (HalfSpace, {"point": (0.0, np.nan, 0.0)}, "region.point must be finite"),
        (BoxRegion, {"lower": (1.0, 0.0, 0.0), "upper": (0.0, 1.0, 1.0)}, "region.lower must not exceed region.upper"),
        (BoxRegion, {"lower": (np.nan, 0.0, 0.0)}, "region.lower must not exceed region.upper"),
        (Ball, {"radius": 0.0}, "region.radius must be positive, found 0.0 m"),
        (Ball, {"radius": np.nan}, "region.radius must be positive"),
        (Ball, {"center": (0.0, np.inf, 0.0)}, "region.center must be finite"),
    ],
)
def test_meaningless_regions_are_refused(kind: type[Region], settings: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        kind(**settings)


def test_a_region_is_where_a_function_of_all_points_is_true() -> None:
    np.testing.assert_array_equal(Where(lambda points: points[:, 0] + points[:, 1] < 0.3).contains(POINTS), POINTS[:, 0] + POINTS[:, 1] < 0.3)
    assert Where(lambda points: [1] * len(points)).contains(POINTS).all()  # type: ignore[arg-type, return-value]


@pytest.mark.parametrize(
    ("predicate", "message"),
    [
        (
            lambda points: points[0] < 0.1,
            r"must answer for each of the 500 points at once, found 3 answers; write it .* such as lambda points: points\[:, 0\] < 0",
        ),
        (lambda points: True, r"the answer of a region's predicate must be an array \(points\) of true and false, found True"),
        (lambda points: points[:, 0], r"of true and false, found an array \(500,\) of float64"),
        (lambda points: points < 0.1, r"of true and false, found an array \(500, 3\) of bool"),
    ],
)
def test_a_function_that_does_not_answer_for_each_point_is_refused(predicate: Callable[[np.ndarray], np.ndarray], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Where(predicate).contains(POINTS)


def test_every_region_that_settings_can_hold_has_a_name_on_the_command_line() -> None:
    ours = {kind for kind in Region.__subclasses__() if kind.__module__ == Region.__module__ and not inspect.isabstract(kind)}
    assert set(REGIONS.values()) == ours - {Where}
