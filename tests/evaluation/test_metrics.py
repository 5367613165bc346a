"""Surface errors against shapes whose distance is known, topology, and how frames are summed up."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh

from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.field_errors import field_errors
from sdfnet.evaluation.metrics import NO_SURFACE, SurfaceErrors, aggregate, surface_errors, topology, vertex_errors
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface

RADIUS = 0.05
DIAGONAL = 0.2
SAMPLES = 20_000


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


def moved(mesh: trimesh.Trimesh, offset: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices + offset, mesh.faces, process=False)


def ball(radius: float = RADIUS) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def together(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return trimesh.Trimesh(np.vstack([mesh.vertices for mesh in meshes]), np.vstack(faces), process=False)


def compare(predicted: trimesh.Trimesh, true: trimesh.Trimesh, seed: int = 0) -> SurfaceErrors:
    return surface_errors(surface_of(predicted), surface_of(true), DIAGONAL, samples=SAMPLES, seed=seed)


def test_equal_surfaces_differ_by_rounding_only() -> None:
    errors = compare(ball(), ball())
    assert errors.hausdorff_mm < 2e-5  # two float32 roundings of 0.05 m, 4e-9 m each, in three coordinates
    assert errors.f_score_0p1_percent == 1.0
    # Samples within rounding of an edge may land on the face across it, a few degrees away.
    assert errors.normal_cosine > 0.9999
    assert (errors.components, errors.genus, errors.is_watertight) == (1, 0, True)


@pytest.mark.parametrize("gap", [0.0004, -0.003])
def test_concentric_balls_differ_by_the_gap(gap: float) -> None:
    errors, flatness = compare(ball(RADIUS + gap), ball()), np.linalg.norm(ball().triangles_center, axis=1).min() / RADIUS
    # Of two scaled copies of a convex solid every point is at most the gap away, and at least the gap between parallel faces.
    bounds = (flatness * abs(gap) * 1e3 - 1e-5, abs(gap) * 1e3 + 1e-5)
    for name in ("accuracy_mm", "completeness_mm", "chamfer_l1_mm", "rms_mm", "p99_mm", "hausdorff_mm"):
        assert bounds[0] <= getattr(errors, name) <= bounds[1], name
    assert errors.f_score_0p1_percent == 0.0
    assert errors.f_score_0p5_percent == (1.0 if abs(gap) < 0.001 else 0.0)
    assert errors.normal_degrees < 5


def test_accuracy_looks_from_the_prediction_and_completeness_from_the_truth() -> None:
    stray = together(ball(), moved(ball(), (0.5, 0.0, 0.0)))
    more, less = compare(stray, ball()), compare(ball(), stray)
    # Half of the samples lie on the stray ball. Its points are 0.5 - 0.05 away on average, to R^2 / 3d = 1.7e-3 m.
    assert more.accuracy_mm == pytest.approx(0.5 * 450, rel=0.02)
    assert more.completeness_mm < 2e-5
    assert (less.accuracy_mm, less.completeness_mm) == pytest.approx((more.completeness_mm, more.accuracy_mm), rel=1e-9)
    assert more.chamfer_l1_mm == pytest.approx((more.accuracy_mm + more.completeness_mm) / 2)
    # One number in each direction: the stray ball's far side, and nothing.
    assert more.hausdorff_mm == pytest.approx(500, rel=1e-3)
    assert more.rms_mm == pytest.approx(math.sqrt(0.25) * 450, rel=0.02)
    assert more.components == 2
    # Precision 1/2 and recall 1.
    assert more.f_score_1_percent == pytest.approx(2 / 3, rel=0.02)


def test_surface_turned_inside_out_has_normal_cosine_minus_one() -> None:
    inverted = ball()
    inverted.invert()
    errors = compare(inverted, ball())
    assert errors.normal_cosine < -0.9999
    assert errors.normal_degrees > 179
    assert errors.chamfer_l1_mm < 1e-5


def test_mean_is_taken_over_area_and_not_over_triangles() -> None:
    crowded, shift = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS), 0.002
    polar, azimuth = np.arccos(crowded.vertices[:, 2] / RADIUS), np.arctan2(crowded.vertices[:, 1], crowded.vertices[:, 0])
    polar = polar**2 / np.pi  # crowds the triangles about the north pole: their median lies at 45 degrees
    directions = np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    crowded = trimesh.Trimesh(RADIUS * directions, crowded.faces, process=False)
    # A shift along z moves a ball's surface by shift x |cos(polar)|, half the shift on average; over triangles it would be 0.7 of it.
    # Sampling error 0.4 %; the coarse south pole is inscribed 6e-4 of the radius deep, 3 % of the mean.
    assert compare(crowded, moved(ball(), (0.0, 0.0, shift))).accuracy_mm == pytest.approx(shift * 1e3 / 2, rel=0.03)


def test_samples_are_even_within_a_triangle() -> None:
    slope, half = 0.02, RADIUS
    cube = trimesh.creation.box((2 * half,) * 3)
    sheared = trimesh.Trimesh(cube.vertices + slope * cube.vertices[:, :1] * [0, 0, 1], cube.faces, process=False)
    # Top and bottom, a third of the area, lie slope |x| off, on average slope half / 2; the sides slide within themselves.
    # Sampling error 0.9 %; the strips where a side has slid off add 1 %.
    assert compare(cube, sheared).accuracy_mm == pytest.approx(1e3 * slope * half / 2 / 3, rel=0.03)


def test_seed_fixes_the_samples() -> None:
    true = moved(ball(), (0.01, 0.0, 0.0))
    assert compare(ball(), true, seed=0) == compare(ball(), true, seed=0)
    assert compare(ball(), true, seed=0) != compare(ball(), true, seed=1)


def test_search_tree_of_the_truth_can_be_handed_in() -> None:
    predicted, true = surface_of(ball()), surface_of(ball(RADIUS + 0.001))
    refitted = SurfaceDistance(predicted)
    refitted.deform(true.vertices)
    errors = surface_errors(predicted, true, DIAGONAL, SAMPLES, true_distance=refitted)
    # A refitted tree visits boxes in another order; only ties may fall differently.
    assert errors.chamfer_l1_mm == pytest.approx(surface_errors(predicted, true, DIAGONAL, SAMPLES).chamfer_l1_mm, rel=1e-6)


def test_vertex_errors_are_distances_of_vertices() -> None:
    outside = ball(RADIUS + 0.002)
    np.testing.assert_allclose(vertex_errors(surface_of(outside), SurfaceDistance(surface_of(ball()))), 2.0, rtol=1e-5)


def test_components_and_handles_are_counted() -> None:
    ring = trimesh.creation.torus(1.0, 0.3)
    assert topology(surface_of(ring)) == (1, 1, True)
    assert topology(surface_of(together(ring, moved(ring, (4.0, 0.0, 0.0)), moved(ball(), (9.0, 0.0, 0.0))))) == (3, 2, True)


def test_vertices_of_no_face_are_no_component() -> None:
    whole = surface_of(ball())
    assert topology(Surface(np.vstack([np.zeros((2, 3)), whole.vertices]), whole.faces + 2)) == (1, 0, True)


def test_missing_or_flipped_face_is_not_watertight() -> None:
    whole = surface_of(ball())
    flipped = whole.faces.copy()
    flipped[7] = flipped[7, ::-1]
    assert topology(Surface(whole.vertices, whole.faces[1:])) == (1, -1, False)
    assert topology(Surface(whole.vertices, flipped)) == (1, -1, False)


def scored(chamfer: float, cosine: float) -> SurfaceErrors:
    perfect = compare(ball(), ball())
    return dataclasses.replace(perfect, chamfer_l1_mm=chamfer, normal_cosine=cosine)


def test_summary_names_mean_worst_and_worst_frame() -> None:
    summary = aggregate({5: scored(1.0, 0.9), 10: scored(4.0, 0.95), 95: scored(1.0, 0.7)})
    assert (summary["frames"], summary["failed_frames"]) == (3, 0)
    assert [summary[f"chamfer_l1_mm_{kind}"] for kind in ("mean", "worst", "worst_frame")] == [2.0, 4.0, 10]
    assert [summary[f"normal_cosine_{kind}"] for kind in ("worst", "worst_frame")] == [0.7, 95]
    assert summary["is_watertight_mean"] == 1.0


def test_frame_without_surface_is_counted_and_spoils_the_mean() -> None:
    summary = aggregate({0: scored(1.0, 0.9), 1: NO_SURFACE})
    assert summary["failed_frames"] == 1
    assert summary["chamfer_l1_mm_mean"] == math.inf
    assert [summary[f"f_score_1_percent_{kind}"] for kind in ("mean", "worst", "worst_frame")] == [0.5, 0.0, 1]


@pytest.mark.parametrize("metric", [field.name for field in dataclasses.fields(SurfaceErrors) if field.name not in ("components", "genus")])
def test_no_surface_is_worse_than_any_surface(metric: str) -> None:
    assert aggregate({3: NO_SURFACE, 4: scored(1e3, -0.5)})[f"{metric}_worst_frame"] == 3


def test_band_without_points_shows_in_the_summary() -> None:
    empty_band = field_errors(torch.zeros(1), torch.ones(1), diagonal=1.0)
    assert math.isnan(aggregate({0: empty_band})["mae_within_1_percent_mm_mean"])


def test_summary_of_no_frame_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="at least one frame"):
        aggregate({})
