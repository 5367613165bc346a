"""Networks beside other ways to keep the same shapes: errors, bytes and times of a small ball."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sdfnet.cost import network_study
from sdfnet.cost.field_baselines import NetworkField
from sdfnet.cost.network_study import (
    ALL_SAMPLES,
    QUICK,
    Candidate,
    Effort,
    MeasuredShape,
    baseline_candidates,
    compared_frames,
    measured_shapes,
    network_candidate,
    network_studies,
    networks_trained_on,
    sweep_candidates,
    timed_frames,
)
from sdfnet.cost.shape_baselines import PodMotion
from sdfnet.cost.sweep_table import FAILED, FINISHED, Job
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.store import DistanceSamples, described
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.metrics import surface_errors
from sdfnet.evaluation.reconstruct import Grid
from sdfnet.evaluation.settings import EvaluationSettings
from sdfnet.models.networks import CHECKPOINT_PREFIX, RECORD, Networks, load_networks
from sdfnet.models.quantise import quantised
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.trajectory import Trajectory
from tests.cost.conftest import ball_networks
from tests.evaluation.shape_family import ball_trajectory

FRAMES = 7
ASKED: dict[str, Any] = {"model": ModelSettings(width=8, depth=1, latent=2, encoder_width=4, encoder_depth=1), "split": "all"}
SMALL = Effort(
    every=1,
    resolution=24,
    surface_samples=1_000,
    queries=500,
    repeats=2,
    modes=(1, 3, 99),
    strides=(1, 3),
    grid_points=(2, 8, 16),
    nearest_samples=(200, ALL_SAMPLES),
)


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A ball that is deformed."""
    return ball_trajectory(FRAMES)


@pytest.fixture(scope="module")
def shapes(trajectory: Trajectory, samples: DistanceSamples) -> dict[tuple[str, str], MeasuredShape]:
    """Every baseline, measured, by method and setting."""
    grid = Grid(samples.box.lower, samples.box.upper, SMALL.resolution)
    found = measured_shapes(baseline_candidates(trajectory, samples, grid, SMALL), trajectory, samples, SMALL)
    return {(shape.candidate.method, shape.candidate.setting): shape for shape in found}


def trained(trajectory: Trajectory, samples: DistanceSamples, folder: Path, vertices: int | None = None) -> Job:
    """A job whose network is a ball of 4 cm in every frame: no training is needed for that."""
    lower, upper = (torch.from_numpy(corner).float() for corner in (samples.box.lower, samples.box.upper))
    settings = ASKED["model"]
    networks = Networks(settings, torch.from_numpy(trajectory.surface_vertices[:, :vertices].astype(np.float32)), lower, upper)
    (folder / "checkpoints").mkdir(parents=True)
    record = {"model": {name: getattr(settings, name) for name in ("width", "depth", "latent", "encoder_width", "encoder_depth")}}
    weights = {CHECKPOINT_PREFIX + name: values for name, values in networks.state_dict().items()}
    torch.save({RECORD: record, "state_dict": weights}, folder / "checkpoints" / "last.ckpt")
    result: dict[str, Any] = {**networks.sizes(FRAMES), "chamfer_l1_mm_mean": 0.25, "chamfer_l1_mm_worst": 0.5, "failed_frames": 0, "frames": FRAMES}
    result |= {"train_seconds": 1.0, "storage": "float32", "settings": described(ASKED | {"evaluation": EvaluationSettings(resolution=40)})}
    return Job(folder, ("model.width=8", "seed=1"), FINISHED, result=result)


def test_more_bytes_are_less_error_along_every_series(shapes: dict[tuple[str, str], MeasuredShape]) -> None:
    for method, less, more in (
        ("POD, exact query", "1 mode", "3 modes"),
        ("kept frames, exact query", "every 3", "every 1"),
        ("grid of distances", "8^3", "16^3"),
    ):
        small, large = shapes[method, less], shapes[method, more]
        assert (small.bytes or 0) < (large.bytes or 0)
        assert (small.mean_mm or 0) > 2 * (large.mean_mm or 0), method
    assert shapes["KNN-1", "1,949 samples"].failure is None
    assert ("POD, exact query", "99 modes") not in shapes, "more modes than frames"


def test_errors_are_the_mean_and_the_worst_of_the_measured_frames(trajectory: Trajectory, shapes: dict[tuple[str, str], MeasuredShape]) -> None:
    pod = shapes["POD, exact query", "1 mode"]
    model = pod.candidate.make()
    by_frame = [
        surface_errors(model.surface(frame), trajectory.surface(frame), trajectory.mesh.diagonal, SMALL.surface_samples).chamfer_l1_mm
        for frame in range(1, FRAMES)
    ]
    assert pod.mean_mm == pytest.approx(np.mean(by_frame), rel=1e-6)
    assert pod.worst_mm == pytest.approx(max(by_frame), rel=1e-6)
    errors = {study.name: [point.error_mm for point in study.points] for study in network_studies([pod])}
    assert errors == {
        "network_query": [pod.mean_mm], "network_frame": [pod.mean_mm], "network_bytes_mean": [pod.mean_mm], "network_bytes_worst": [pod.worst_mm],
        "network_parameters": [],  # which it has none of
    }  # fmt: skip


def test_what_has_no_surface_keeps_its_place_with_the_reason(shapes: dict[tuple[str, str], MeasuredShape]) -> None:
    coarse = shapes["grid of distances", "2^3"]
    assert "both sides of zero" in (coarse.failure or "")
    assert "close inside the grid" in (shapes["KNN-1", "200 samples"].failure or "")
    assert coarse.query is None
    assert not network_studies([coarse])[0].points[0].is_measured


def test_each_timing_pays_for_a_change_of_frame(trajectory: Trajectory, samples: DistanceSamples, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    vertices = PodMotion.vertices

    def recorded(motion: PodMotion, frame: int) -> np.ndarray:
        asked.append(frame)
        return vertices(motion, frame)

    monkeypatch.setattr(PodMotion, "vertices", recorded)
    monkeypatch.setattr(network_study, "LEAST_SECONDS", 0.0)
    pod = replace(SMALL, modes=(1,), strides=(), grid_points=(), nearest_samples=())
    grid = Grid(samples.box.lower, samples.box.upper, pod.resolution)
    measured_shapes(baseline_candidates(trajectory, samples, grid, pod), trajectory, samples, pod)
    # Errors of all compared frames; the first hierarchy, which is of frame 0; then a warm-up and two repeats of queries and of surfaces.
    assert asked == [1, 2, 3, 4, 5, 6] + [0] + [1, 2, 3] + [1, 2, 3]


def test_frames_that_are_timed_are_not_those_that_are_compared() -> None:
    assert timed_frames(compared_frames(13, 3), 13) == [4, 7, 10]
    assert timed_frames([1, 2], 3) == [0, 1, 2], "a single frame after itself would be no change of frame"


@pytest.mark.parametrize("count", [3, 9, 21, 44, 45, 101])
@pytest.mark.parametrize("effort", [Effort(), QUICK])
def test_kept_frames_are_measured_where_they_are_not_exact(count: int, effort: Effort) -> None:
    """The last frame is always kept, and compared. Of those before it no larger part is among the compared than is kept, but for one frame."""
    *frames, last = compared_frames(count, effort.every)
    assert last == count - 1
    assert 0 not in frames
    for stride in effort.strides:
        kept = [frame for frame in frames if frame % stride == 0]
        assert len(kept) <= len(frames) / stride + 1
        assert len(kept) < len(frames) or stride > count - 2


@pytest.mark.parametrize("every", [1, 3, 11])
def test_each_load_case_is_compared_to_its_end_and_not_at_rest(every: int) -> None:
    frames = compared_frames(84, every, cases=4)
    assert {20, 41, 62, 83} <= set(frames)
    assert not {0, 21, 42, 63} & set(frames)


def test_networks_of_jobs_stand_beside_the_baselines(trajectory: Trajectory, samples: DistanceSamples, tmp_path: Path) -> None:
    job = trained(trajectory, samples, tmp_path / "run")
    lost = Job(tmp_path / "gone", (), FINISHED, result=job.result)
    killed = Job(tmp_path / "killed", (), FAILED, "killed")
    other_mesh = replace(trained(trajectory, samples, tmp_path / "other", vertices=5), overrides=("model.width=9",))
    small = Effort(every=3, resolution=8, surface_samples=100, queries=50, repeats=1, modes=(1,), strides=(), grid_points=(), nearest_samples=())
    candidates = sweep_candidates([job, lost, killed, other_mesh], trajectory, grid_of(samples, small), {}, ASKED)
    good, missing, foreign = (one_of(candidates, overrides) for overrides in (job.overrides, (), ("model.width=9",)))
    model = good.make()
    assert job.result is not None
    assert model.bytes == job.result["query_bytes"]
    unmade = measured_shapes([missing, foreign], trajectory, samples, small)
    assert "no checkpoint at" in (unmade[0].failure or "")
    assert "need a mesh of as many" in (unmade[1].failure or "")


def test_network_of_a_sweep_is_measured_as_every_other_is(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its run has measured, on whatever grid and frames; also where its run found no surface."""
    shapes, samples, networks = ball_family.trajectory, ball_family.samples, ball_networks(ball_family)
    monkeypatch.setattr(network_study, "networks_trained_on", lambda files, path: networks)
    small = Effort(every=99, resolution=16, surface_samples=100, queries=50, repeats=1)
    grid = grid_of(samples, small)
    result = networks.sizes(FRAMES) | {
        "chamfer_l1_mm_mean": None,
        "chamfer_l1_mm_worst": None,
        "train_seconds": 1.0,
        "settings": described(ASKED | {"evaluation": EvaluationSettings(resolution=40)}),
    }
    of_sweep = sweep_candidates([Job(Path("run"), (), FINISHED, result=result)], shapes, grid, {}, ASKED)
    swept, at_hand = measured_shapes([*of_sweep, network_candidate("at hand", networks, shapes, grid)], shapes, samples, small)
    assert swept.mean_mm is not None
    assert (swept.mean_mm, swept.worst_mm) == (at_hand.mean_mm, at_hand.worst_mm)
    (point,) = network_studies([swept])[-1].points
    assert point.pair == (swept.mean_mm, networks.decoder.parameter_count)


def test_networks_of_a_sweeps_page_are_told_apart_and_trained_again_one_by_one(trajectory: Trajectory, samples: DistanceSamples, tmp_path: Path) -> None:
    job, page = trained(trajectory, samples, tmp_path / "run"), "sweep=alternatives"
    small = replace(job, overrides=("model=small", "seed=0", page))
    siren = replace(job, overrides=("model=siren", "seed=0", page), result=(job.result or {}) | {"settings": described(ASKED | {"model": ModelSettings()})})
    stored = replace(job, overrides=("model=small", "evaluation.storage=fp16", page), result=(job.result or {}) | {"storage": "fp16"})
    candidates = sweep_candidates([small, siren, stored], trajectory, grid_of(samples, SMALL), {}, ASKED)
    size = (job.result or {})["decoder_parameters"]
    names = ("model=small", "model=siren", "model=small evaluation.storage=fp16")
    assert {candidate.setting for candidate in candidates} == {f"{name}, {size:,} parameters" for name in names}
    assert {candidate.overrides for candidate in candidates} == {(*one.overrides, "hydra.mode=RUN") for one in (small, siren, stored)}
    assert [candidate.setting.split(",")[0] for candidate in candidates if candidate.is_default] == ["model=small"]


def grid_of(samples: DistanceSamples, effort: Effort) -> Grid:
    return Grid(samples.box.lower, samples.box.upper, effort.resolution)


def one_of(candidates: list[Candidate], setting: tuple[str, ...]) -> Candidate:
    (found,) = [candidate for candidate in candidates if candidate.overrides == setting]
    return found


def seeds_of(job: Job, means: list[float | None]) -> list[Job]:
    """Jobs of one setting with these mean errors, each in a folder of its own; the worst frame errs twice as much."""
    return [
        replace(
            job,
            folder=job.folder.with_name(f"seed_{seed}"),
            overrides=("model.width=8", f"seed={seed}"),
            result=(job.result or {})
            | {"chamfer_l1_mm_mean": mean, "chamfer_l1_mm_worst": None if mean is None else 2 * mean, "failed_frames": int(mean is None)},
        )
        for seed, mean in enumerate(means)
    ]


def test_seeds_of_a_setting_are_one_point_with_their_median_and_never_the_luckiest(
    trajectory: Trajectory, samples: DistanceSamples, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, asked = trained(trajectory, samples, tmp_path / "run"), list[Path]()
    checkpoint = job.folder / "checkpoints" / "last.ckpt"

    def recorded(files: dict[str, str], path: Path) -> Networks:
        asked.append(path)
        return networks_trained_on(files, checkpoint)

    monkeypatch.setattr(network_study, "networks_trained_on", recorded)
    (point,) = sweep_candidates(seeds_of(job, [0.4, 0.1, 0.2]), trajectory, grid_of(samples, SMALL), {}, ASKED)
    assert point.overrides == ("model.width=8", "seed=2")
    assert "model.width=8, the middle one of 3 seeds (0.1 mm to 0.4 mm in their runs, on 40^3 points), " in point.setting
    point.make()
    assert [path.parents[1].name for path in asked] == ["seed_2"], "the seed in the middle is asked"
    (lost,) = sweep_candidates(seeds_of(job, [0.4, None, None]), trajectory, grid_of(samples, SMALL), {}, ASKED)
    assert "(0.4 mm to no surface in their runs, on 40^3 points)" in lost.setting


@pytest.mark.parametrize("storage", ["float32", "fp16", "int8"])
def test_bytes_and_errors_are_of_the_same_storage(trajectory: Trajectory, samples: DistanceSamples, tmp_path: Path, storage: str) -> None:
    job = trained(trajectory, samples, tmp_path / "run")
    networks = load_networks(job.folder / "checkpoints" / "last.ckpt")
    stored = replace(job, result=(job.result or {}) | {"storage": storage})
    (candidate,) = sweep_candidates([stored], trajectory, grid_of(samples, SMALL), {}, ASKED)
    model, expected = candidate.make(), NetworkField(quantised(networks, storage), trajectory.surface_vertices)
    points = torch.from_numpy(samples.points)
    assert model.bytes == expected.bytes
    assert torch.equal(model.distances(2, points), expected.distances(2, points))
    assert torch.equal(model.distances(2, points), NetworkField(networks, trajectory.surface_vertices).distances(2, points)) == (storage == "float32")


def test_network_of_another_dataset_is_refused(trajectory: Trajectory, samples: DistanceSamples, tmp_path: Path) -> None:
    job = trained(trajectory, samples, tmp_path / "run")
    checkpoint = job.folder / "checkpoints" / "last.ckpt"
    contents = torch.load(checkpoint, weights_only=True)
    files = {"trajectory": "trajectory-1.h5", "distances": "distances-2.h5"}
    contents[RECORD] |= files
    torch.save(contents, checkpoint)
    assert networks_trained_on(files, checkpoint).settings.width == 8
    other = files | {"distances": "distances-3.h5"}
    message = re.escape("trained on the dataset that is studied, trajectory-1.h5, distances-3.h5, found trajectory-1.h5, distances-2.h5; choose the dataset")
    with pytest.raises(ConfigurationError, match=message):
        networks_trained_on(other, checkpoint)
    (candidate,) = sweep_candidates([job], trajectory, grid_of(samples, SMALL), other, ASKED)
    (shape,) = measured_shapes([candidate], trajectory, samples, SMALL)
    assert "found trajectory-1.h5, distances-2.h5" in (shape.failure or "")
