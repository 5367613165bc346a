"""Evaluation and its report on a small ball whose distances are known."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from sdfnet.data.prepare import sample_distances
from sdfnet.data.store import DistanceSamples
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.evaluate import Evaluation, evaluate, measured_frames
from sdfnet.evaluation.figures import PANEL_PIXELS
from sdfnet.evaluation.report import result_of, table_of, write_report
from sdfnet.evaluation.settings import EvaluationSettings
from sdfnet.geometry.solids import Sphere
from sdfnet.models.decoder import SdfCalculator
from sdfnet.models.networks import Networks
from sdfnet.models.quantise import quantised
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Sampling

SETTINGS = EvaluationSettings(resolution=24, surface_samples=2_000, volume_samples=5_000, volume_frames=1, mesh_frames=(-1,))


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A ball that grows by a tenth over three frames."""
    mesh = Sphere(radius=0.05, cells=6).tet_mesh()
    growth = np.array([0.0, 0.05, 0.1])[:, None, None] * mesh.nodes
    return Trajectory(mesh, np.array([0.0, 1.0, 2.0]), growth, 1.0, {})


@pytest.fixture(scope="module")
def samples(trajectory: Trajectory) -> DistanceSamples:
    """Its distances, few but enough."""
    return sample_distances(trajectory, Sampling(count=5_000, near_surface_count=2_000))


def networks(trajectory: Trajectory, samples: DistanceSamples) -> Networks:
    """Untrained networks."""
    surface = torch.from_numpy(trajectory.mesh.nodes[trajectory.mesh.surface_nodes]).float()
    lower, upper = (torch.from_numpy(corner).float() for corner in (samples.box.lower, samples.box.upper))
    return Networks(ModelSettings(width=8, depth=1, latent=2), surface.expand(3, -1, -1), lower, upper)


class _BallOfKnownRadius(SdfCalculator):
    """The exact distance of a ball whose radius is the latent."""

    def encoded(self, points: torch.Tensor) -> torch.Tensor:
        return points.norm(dim=-1, keepdim=True)

    def from_both(self, from_latent: torch.Tensor, encoded: torch.Tensor, in_place: bool = False) -> torch.Tensor:
        return encoded[..., 0] - from_latent[..., 0]


def knowing(trajectory: Trajectory, samples: DistanceSamples) -> Networks:
    """Networks that know the answer."""
    known = networks(trajectory, samples)
    known.decoder = _BallOfKnownRadius(known.settings, torch.zeros(3), torch.ones(3))
    known.decoder.from_latent = torch.nn.Identity()  # type: ignore[assignment]
    known.latents = lambda shapes: shapes.norm(dim=-1).amax(dim=1, keepdim=True)  # type: ignore[method-assign]
    return known


@pytest.fixture(scope="module")
def exact(trajectory: Trajectory, samples: DistanceSamples) -> Evaluation:
    """Their evaluation."""
    return evaluate(knowing(trajectory, samples), trajectory, samples, SETTINGS)


def test_vertices_that_are_refined_lie_on_the_networks_own_surface(trajectory: Trajectory, samples: DistanceSamples, exact: Evaluation) -> None:
    refined = evaluate(knowing(trajectory, samples), trajectory, samples, replace(SETTINGS, refine_steps=1))
    radius = float(np.linalg.norm(trajectory.surface(2).vertices, axis=1).max())
    off = [np.abs(np.linalg.norm(one.surfaces[2]["network"].vertices, axis=1) - radius).max() for one in (exact, refined)]
    assert off[0] > 1e-5  # m: what marching cubes leaves between the points of the grid
    assert off[1] < 1e-7
    np.testing.assert_array_equal(exact.surfaces[2]["floor"].vertices, refined.surfaces[2]["floor"].vertices)


def test_a_network_that_knows_the_ball_is_as_good_as_the_floor_but_for_the_facets(exact: Evaluation) -> None:
    summary = exact.summary([1])
    # The true surface is a polyhedron of 6 cells across inside the sphere: its faces lie up to 1.5 mm, on average 0.8 mm, under it.
    assert summary["chamfer_l1_mm_mean"] < summary["floor_chamfer_l1_mm_mean"] + 1.0
    assert summary["failed_frames"] == 0
    assert summary["unseen_frames"] == 1
    assert summary["intersection_over_union_mean"] > 0.9
    assert summary["eikonal_mean"] < 1e-4, "the gradient of a distance has length one"
    assert summary["skill"] == pytest.approx(1 - summary["chamfer_l1_mm_mean"] / summary["knn1_chamfer_l1_mm_mean"])


def test_frames_never_trained_on_are_measured_whatever_the_stride(trajectory: Trajectory, samples: DistanceSamples) -> None:
    untrained = networks(trajectory, samples)
    settings = replace(SETTINGS, every=5, mesh_frames=())
    assert sorted(evaluate(untrained, trajectory, samples, settings).surface_errors["network"]) == [0, 2]
    assert sorted(evaluate(untrained, trajectory, samples, settings, unseen_frames=[1]).surface_errors["network"]) == [0, 1, 2]


@torch.no_grad()
@pytest.mark.parametrize("storage", ["fp16", "int8"])
def test_networks_are_measured_and_weighed_as_they_are_stored(trajectory: Trajectory, samples: DistanceSamples, storage: str) -> None:
    shapes = torch.from_numpy(trajectory.surface_vertices.astype(np.float32))
    trained = Networks(ModelSettings(width=8, depth=1, latent=2), shapes, torch.full((3,), -0.1), torch.full((3,), 0.1))
    before = {name: values.clone() for name, values in trained.state_dict().items()}
    evaluation = evaluate(trained, trajectory, samples, replace(SETTINGS, storage=storage))
    stored = quantised(trained, storage)
    points = torch.from_numpy(np.concatenate([samples.points, samples.near_points]))
    true = torch.from_numpy(np.concatenate([samples.distances[-1], samples.near_distances[-1]]))
    latents = stored.latents(shapes)[-1:]
    # the same numbers, added up in other chunks
    (field_errors,) = evaluation.field_errors.values()  # of the last frame, where there is one volume frame
    assert field_errors.mae_mm == pytest.approx(1e3 * float((stored.decoder(latents, points)[0] - true).abs().mean()), rel=1e-5)
    result = result_of(evaluation, trajectory, [0, 1, 2], {}, {})
    assert (result["storage"], result["query_bytes"]) == (storage, stored.sizes(3)["query_bytes"])
    assert f"size, stored as {storage}" in list(table_of(result).columns[0].cells)
    assert all(torch.equal(values, before[name]) for name, values in trained.state_dict().items())


def test_an_encoder_that_tells_no_frame_from_another_is_said_to(
    exact: Evaluation, trajectory: Trajectory, samples: DistanceSamples, caplog: pytest.LogCaptureFixture
) -> None:
    dead = networks(trajectory, samples)
    torch.nn.init.zeros_(dead.encoder.get_parameter("layers.0.weight"))
    evaluation = evaluate(dead, trajectory, samples, SETTINGS)
    assert evaluation.summary([])["distinct_latents"] == 1
    assert "every frame has the same latent" in caplog.text
    assert exact.summary([])["distinct_latents"] == 3


def test_a_network_without_a_surface_is_counted_as_failed(
    trajectory: Trajectory, samples: DistanceSamples, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    blind = networks(trajectory, samples)
    torch.nn.init.constant_(blind.decoder.get_parameter("layers.0.bias"), 100.0)  # far outside everywhere
    evaluation = evaluate(blind, trajectory, samples, SETTINGS)
    result = result_of(evaluation, trajectory, [0, 1, 2], {"train": 1.0}, {"seed": 0})
    assert result["failed_frames"] == 3
    assert result["chamfer_l1_mm_mean"] == math.inf
    assert "network: counted as failed: no surface: the network gives only positive distances (" in caplog.text
    assert "m); train longer" in caplog.text
    cells = list(table_of(result).columns[1].cells)
    assert "inf" not in " ".join(map(str, cells))
    assert cells[0] == "no surface"
    write_report(tmp_path, evaluation, result, trajectory)
    written = json.loads((tmp_path / "result.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert written["chamfer_l1_mm_mean"] is None
    assert table_of(result).row_count > 5
    assert imread(tmp_path / "figure5_frame_002.png").shape[1] == 3 * PANEL_PIXELS[0], "the network keeps its panel"


def test_a_network_that_is_negative_everywhere_is_told_to_train_and_not_to_enlarge_the_box(
    trajectory: Trajectory, samples: DistanceSamples, caplog: pytest.LogCaptureFixture
) -> None:
    full = networks(trajectory, samples)
    torch.nn.init.constant_(full.decoder.get_parameter("layers.0.bias"), -100.0)
    failures = evaluate(full, trajectory, samples, SETTINGS).failures
    assert sorted(failures) == [0, 1, 2]
    assert "negative distances" in failures[0]
    assert "enlarge the box" not in caplog.text


def test_the_last_frame_is_always_measured() -> None:
    assert measured_frames(11, 4) == [0, 4, 8, 10]
    assert measured_frames(3, 1) == [0, 1, 2]


def test_settings_that_measure_nothing_are_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"evaluation\.every"):
        EvaluationSettings(every=0)
    with pytest.raises(ConfigurationError, match=r"evaluation\.refine_steps must be at least 0, found -1"):
        EvaluationSettings(refine_steps=-1)
    with pytest.raises(ConfigurationError, match=r"evaluation\.storage must be one of float32, fp16, int8; found 'int4'"):
        EvaluationSettings(storage="int4")


def test_a_mesh_frame_that_does_not_exist_is_refused() -> None:
    settings = EvaluationSettings(mesh_frames=(500,))
    with pytest.raises(ConfigurationError, match=r"mesh_frames must lie in \[-101, 100\] for 101 frames, found \[500\]"):
        settings.require_frames(101)
