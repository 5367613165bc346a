"""Whole commands on the smallest scene: what a newcomer does first."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

SMOKE = ("experiment=smoke", "trainer.progress_bar=false")
ISSUE_NAMES = (
    "chamfer_l1_mm_mean",
    "chamfer_l1_mm_worst",
    "knn1_chamfer_l1_mm_mean",
    "knn1_chamfer_l1_mm_worst",
    "floor_chamfer_l1_mm_mean",
    "decoder_parameters",
    "encoder_parameters",
    "train_seconds",
    "prepare_seconds",
)


def test_a_run_leaves_what_the_readme_promises_and_evaluating_its_checkpoint_finds_the_same(
    command: Callable[..., None], newest_result: Callable[[str], Path]
) -> None:
    command("train", *SMOKE)
    folder = newest_result("train")
    result = json.loads((folder / "result.json").read_text())
    assert [name for name in ISSUE_NAMES if name not in result] == []
    assert result["chamfer_l1_mm_mean"] < 0.5 * result["knn1_chamfer_l1_mm_mean"], "300 steps beat KNN-1 on a ball by a factor of four"
    assert result["floor_chamfer_l1_mm_mean"] < result["chamfer_l1_mm_mean"]
    assert result["failed_frames"] == 0
    assert (folder / "figure5_frame_010.png").stat().st_size > 20_000
    truth = trimesh.load_mesh(folder / "meshes" / "frame_010_truth.ply")
    network = trimesh.load_mesh(folder / "meshes" / "frame_010_network.ply")
    assert network.volume == pytest.approx(truth.volume, rel=0.02)
    _check_board(folder)

    command("evaluate", f"checkpoint={folder}/checkpoints/last.ckpt", NO_PICTURES, *("evaluation." + one for one in SMOKE_EVALUATION))
    again = json.loads((newest_result("evaluate") / "result.json").read_text())
    assert again["chamfer_l1_mm_mean"] == pytest.approx(result["chamfer_l1_mm_mean"], rel=1e-6)

    command("evaluate", f"checkpoint={folder}/checkpoints/last.ckpt", NO_PICTURES, "evaluation.storage=int8")
    small = json.loads((newest_result("evaluate") / "result.json").read_text())
    assert (result["storage"], small["storage"]) == ("float32", "int8")
    assert small["query_bytes"] < 0.4 * result["query_bytes"], "a quarter, and scales, biases and frequencies"
    assert small["chamfer_l1_mm_mean"] != result["chamfer_l1_mm_mean"]
    assert small["chamfer_l1_mm_mean"] < 2 * result["chamfer_l1_mm_mean"]

    command("train", *SMOKE, "training.epochs=3", "split=interpolation", "evaluation.every=2", NO_PICTURES)
    assert "nothing to prepare" in (newest_result("train") / "train.log").read_text()
    split = json.loads((newest_result("train") / "result.json").read_text())
    assert split["unseen_frames"] < split["frames"]
    assert split["unseen_chamfer_l1_mm_mean"] > 0


NO_PICTURES = "evaluation.mesh_frames=[]"
SMOKE_EVALUATION = ("resolution=32", "every=5", "surface_samples=8192", "volume_samples=20000", "volume_frames=1")


def _check_board(folder: Path) -> None:
    board = EventAccumulator(str(folder / "tensorboard")).Reload()
    expected = {"loss/train_mean", "loss/train_max", "loss/validation_mean", "loss/validation_max", "rate/encoder", "rate/decoder", "phase/encoder_trains"}
    expected |= {"latent/cosine_first_to_last", "latent/cosine_to_first_by_frame", "final/chamfer_l1_mm_mean"}
    assert expected - set(board.Tags()["scalars"]) == set()
    parts = {f"{name}/surface_{part}" for name in ("truth", "network", "knn1", "floor") for part in ("VERTEX", "FACE", "COLOR")}
    assert parts - set(board.Tags()["tensors"]) == set()
    losses = [event.value for event in board.Scalars("loss/train_mean")]
    assert losses[-1] < 0.5 * losses[0], "the loss falls"


@pytest.mark.slow
def test_every_shipped_dataset_but_the_bunny_trains(command: Callable[..., None], newest_result: Callable[[str], Path]) -> None:
    command("train", *SMOKE, "dataset=beam_bend", "training.epochs=2")
    result = json.loads((newest_result("train") / "result.json").read_text())
    assert result["settings"]["dataset"]["scene"]["geometry"]["kind"] == "Box"


@pytest.mark.slow
def test_the_papers_recipe_runs_on_a_small_solid(command: Callable[..., None], newest_result: Callable[[str], Path]) -> None:
    command(
        "train", "experiment=paper", "dataset=sphere_squeeze", "dataset.scene.solver.time_step=auto", "training.epochs=9",
        "trainer.progress_bar=false", *("evaluation." + one for one in SMOKE_EVALUATION),
    )  # fmt: skip
    result = json.loads((newest_result("train") / "result.json").read_text())
    assert result["decoder_parameters"] == 132_609
    assert result["settings"]["batch"]["points_per_step"] is None
