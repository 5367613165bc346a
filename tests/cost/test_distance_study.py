"""What signed distances cost: exact methods are exact, approximations are not, and what is missing keeps its place."""

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import igl
import numpy as np
import pytest

from sdfnet.cost.distance_study import Queries, _ours, _timed, distance_study, exact_distances, package, query_points
from sdfnet.cost.findings import front_of
from sdfnet.cost.studies import Point, Study, Timing
from sdfnet.errors import ConfigurationError
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.surface import Surface
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Sampling

COUNT = 4_500
SAMPLING = Sampling(count=20_000, near_surface_count=10_000)
FLOAT32_MM = 1e-3  # what the project promises of its distances: 1e-6 m


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A ball that is pressed flat, in two steps."""
    mesh = Sphere(radius=0.05, cells=6).tet_mesh()
    pressed = mesh.nodes * np.array([0.1, 0.05, -0.2])
    return Trajectory(mesh, np.arange(3.0), np.stack([0 * pressed, 0.5 * pressed, pressed]), 1.0, {})


@pytest.fixture(scope="module", autouse=True)
def _fixed_timings() -> Iterator[None]:
    """Each task is run once, and is taken to last 1 s with one query and 3 s with all."""

    def timed(tasks: Mapping[str, Callable[[], object]], repeats: int, warm_up: int) -> dict[str, Timing]:
        for task in tasks.values():
            task()
        return {name: Timing.of([1.0 if name.endswith(", one query") else 3.0]) for name in tasks}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sdfnet.cost.distance_study.interleaved", timed)
        yield


@pytest.fixture(scope="module")
def study(trajectory: Trajectory) -> Study:
    return distance_study(trajectory, SAMPLING, COUNT)


def points_of(study: Study, method: str) -> list[Point]:
    found = [point for point in study.points if point.method.startswith(method)]
    assert found
    return found


def test_sdfnet_agrees_with_libigl_whether_refitted_bounded_or_rebuilt(study: Study) -> None:
    for point in points_of(study, "Warp"):
        assert point.is_measured
        assert point.error_mm is not None
        assert 0 < point.error_mm < FLOAT32_MM
        assert point.counts == {"queries": COUNT, "box_sign_errors": 0, "near_surface_sign_errors": 0}


def test_reference_itself_has_no_error_and_winding_numbers_agree_with_it(study: Study) -> None:
    errors = {point.setting: point.error_mm for point in points_of(study, "libigl")}
    assert errors["sign by pseudo-normals"] == 0.0
    assert errors["sign by winding numbers"] == pytest.approx(0.0, abs=1e-12)
    assert (errors["sign by fast winding numbers"] or 0.0) > 1e-6  # libigl multiplies the distance with a sign that is only nearly one
    rounded = errors["sign by pseudo-normals, vertices rounded to float32"]
    assert rounded is not None
    assert 1e-9 < rounded < 1e-5  # mm: half a float32 step at 0.05 m is 2e-9 m


def test_what_has_the_references_distances_by_construction_is_on_no_front(study: Study) -> None:
    references = [point.setting for point in study.points if point.is_reference]
    assert references == ["sign by pseudo-normals", "sign by winding numbers"]
    assert not any(point.is_reference for point in front_of(study))


def test_nearest_neighbours_are_worse_the_fewer_they_are(study: Study) -> None:
    _, *samples = [point.error_mm for point in points_of(study, "scipy")]
    assert None not in samples
    assert samples[0] > samples[1] > samples[2] > FLOAT32_MM  # type: ignore[operator]
    densest = points_of(study, "scipy")[-1].counts  # wrong only for points nearer to the surface than to the edge of their sample's face
    assert densest["box_sign_errors"] + densest["near_surface_sign_errors"] < 0.01 * COUNT


def test_reference_is_libigls_in_float64_at_the_deformed_frame(trajectory: Trajectory) -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.06]], dtype=np.float32)
    surface = trajectory.surface(2)
    expected = igl.point_mesh_squared_distance(points.astype(np.float64), surface.vertices, surface.faces)[0] ** 0.5 * [-1, 1]
    np.testing.assert_allclose(exact_distances(points, surface), expected, rtol=1e-12)
    assert abs(exact_distances(points, surface)[1] - 0.02) < 1e-3  # the pole has come from 0.05 to 0.04


def test_wrong_signs_are_counted_where_they_are(trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A method that calls everything inside is wrong at every point outside, and only there."""
    monkeypatch.setattr("sdfnet.cost.distance_study._to_vertices", lambda surface, asked: -np.abs(exact_distances(asked, surface)))
    point = points_of(distance_study(trajectory, SAMPLING, COUNT), "scipy")[0]
    queries = query_points(trajectory, 2, SAMPLING, COUNT)
    outside = exact_distances(queries.points, trajectory.surface(2)) > 1e-6
    assert point.counts["box_sign_errors"] == (outside & ~queries.is_near).sum() > 0
    assert point.counts["near_surface_sign_errors"] == (outside & queries.is_near).sum() > 0


def test_points_are_the_datasets_own_in_its_proportion(trajectory: Trajectory) -> None:
    queries = query_points(trajectory, 2, SAMPLING, COUNT)
    assert queries.points.shape == (COUNT, 3)
    assert queries.is_near.sum() == COUNT / 3
    distances = np.abs(exact_distances(queries.points, trajectory.surface(2)))
    spread = SAMPLING.near_surface_spread * trajectory.mesh.diagonal
    assert np.quantile(distances[queries.is_near], 0.95) < 2 * spread  # |normal| is under 1.96 deviations for 95 %, and distances are shorter
    assert np.median(distances[~queries.is_near]) > 2 * spread


def test_a_part_of_the_queries_is_spread_over_both_kinds() -> None:
    queries = Queries(np.zeros((12, 3), dtype=np.float32), np.arange(12) >= 8)
    assert queries.every(4).is_near.tolist() == [False, False, True]


def test_one_point_is_what_preparation_does(study: Study) -> None:
    (default,) = [point for point in study.points if point.is_default]
    assert default.setting.startswith("refitted, searched as far")


def test_seconds_are_of_a_million_queries_whatever_was_asked(study: Study) -> None:
    dear = {point.setting: point for point in study.points if point.counts["queries"] < COUNT}
    assert "sign by winding numbers" in dear
    for point in study.points:
        if point.failure is None:
            assert point.seconds is not None
            assert point.seconds.median == pytest.approx(1 + 2 * 1e6 / point.counts["queries"])


def test_a_million_queries_pay_for_one_set_up() -> None:
    """500 queries in 3 s, of which 2 s are of setting up: a million cost 2 s and 2,000 times 1 s."""
    point = _timed(Point("dear", "any", counts={"queries": 500}), Timing(3.0, 2.5, 1.9, 3), set_up=Timing(2.0, 2.0, 2.0, 3))
    assert point.seconds is not None
    assert (point.seconds.median, point.seconds.p5) == pytest.approx((2 + 2000 * 1.0, 2 + 2000 * 0.5))
    assert point.seconds.p95 == 1.9, "quicker than its set-up by the noise of the clock: what was measured, and nothing negative"


def test_study_is_of_a_million_of_all_the_queries_of_the_dataset(study: Study) -> None:
    assert study.share_of_whole == pytest.approx(1e6 / (3 * 30_000))  # three frames, and points of both kinds


def test_what_is_not_installed_is_a_failed_point_that_says_what_to_install(trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rtree", "open3d"):
        monkeypatch.setitem(sys.modules, name, None)
    study = distance_study(trajectory, SAMPLING, COUNT)
    for method, project in (("trimesh", "rtree"), ("Open3D", "open3d")):
        (point,) = points_of(study, method)
        assert not point.is_measured
        halted = f"import of {project} halted; None in sys.modules"
        assert point.failure == f"this method needs {project}, which could not be imported ({halted}); pip install 'sdfnet[cost]'"


def test_a_package_that_lacks_a_library_of_the_system_says_which(monkeypatch: pytest.MonkeyPatch) -> None:
    def imported(name: str) -> None:
        raise OSError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr("importlib.import_module", imported)
    with pytest.raises(ConfigurationError, match=r"needs Open3D, which could not be imported \(libGL.so.1: cannot open shared object file\)"):
        package("open3d", "Open3D")


def test_the_refitted_hierarchy_is_that_of_frame_0(trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[np.ndarray] = []

    class Noted(SurfaceDistance):
        def __init__(self, surface: Surface) -> None:
            built.append(surface.vertices)
            super().__init__(surface)

    monkeypatch.setattr("sdfnet.cost.distance_study.SurfaceDistance", Noted)
    points = query_points(trajectory, 2, SAMPLING, 30).points
    for method in _ours(trajectory, 2, points)[:2]:
        method.answer(points)
    np.testing.assert_array_equal(built, [trajectory.surface(0).vertices])


def test_without_libigl_there_is_no_reference(trajectory: Trajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(ConfigurationError, match="this method needs libigl, which could not be imported .*; pip install 'sdfnet\\[cost]'"):
        distance_study(trajectory, SAMPLING, COUNT)


def test_the_first_frame_has_none_to_be_refitted_from(trajectory: Trajectory) -> None:
    with pytest.raises(ConfigurationError, match="needs a frame with another before it, found frame 0"):
        distance_study(trajectory, replace(SAMPLING, seed=1), COUNT, frame=0)
