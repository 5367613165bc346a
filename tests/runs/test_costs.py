"""The cost command: studies that are asked for, one page, and a clear word where something is missing."""

import csv
import json
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra

from sdfnet.cli import costs
from sdfnet.cli.costs import Bench, _finished_jobs
from sdfnet.cli.entry import register
from sdfnet.cli.settings import STUDIES, CostSettings, TrainSettings
from sdfnet.cost.findings import STUDIES_OF_THE_WHOLE
from sdfnet.cost.network_study import Candidate, MeasuredShape
from sdfnet.cost.studies import Point, Study, Timing
from sdfnet.cost.sweep_table import FAILED, FINISHED, JOB_FILE, RESULT_FILE
from sdfnet.cost.training_study import Trained
from sdfnet.data.store import described
from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.models.networks import RECORD, Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.plan import plan
from sdfnet.plugins import frozen
from sdfnet.scene import Scene
from tests.composition import composed
from tests.runs.resumable_run import BALL

SMALL = (
    "dataset=sphere_squeeze", "dataset.scene.geometry.cells=4", "dataset.sampling.count=4000", "dataset.sampling.near_surface_count=4000",
    "model.width=16", "model.frequencies=12", "model.frequency_scale=0.5", "batch.frames_per_step=4", "batch.points_per_step=256", "batch.steps_per_epoch=20",
    "quick=true",
)  # fmt: skip
Command = Callable[..., None]


def refused(*given: object, **more: object) -> Study:
    """In place of a study."""
    raise PhysicsError("the scene cannot be run so; change it")


def made(name: str) -> Callable[..., Study]:
    """In place of a study that takes seconds."""
    return lambda *given, **more: Study(name, name.title(), "error (mm)", "time (s)", (Point("quick", "as it comes", 0.1, Timing.of([1.0]), is_default=True),))


def page_of() -> Path:
    (page,) = Path("outputs/cost").rglob("report.html")
    return page.parent


def test_asked_studies_make_one_page_with_their_tables(command: Command, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(costs, "distance_study", made("distances"))
    command("cost", *SMALL, "studies=[distances,simulation_time]", "motion_share=0.1")
    folder = page_of()
    with (folder / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(dict.fromkeys(row["study"] for row in rows)) == ["simulation_time", "distances"]  # the order of the flow
    assert sum(row["is_default"] == "1" for row in rows) == 2
    found = json.loads((folder / "cost.json").read_text())
    assert [study["name"] for study in found["studies"]] == ["simulation_time", "distances"]
    assert found["made_with"]["threads"] >= 1
    assert {"processor", "cores", "python", "torch"} <= set(found["made_with"])
    said = capfd.readouterr().out
    assert "What the time step costs" in said
    assert "No cheapest run is named, because these were not measured: training, reconstruction." in said
    assert "python train.py" not in said
    assert "What accuracy costs: sphere_squeeze" in (folder / "report.html").read_text()


def test_share_of_the_motion_that_is_run_is_the_one_that_was_asked_for(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    durations: list[float] = []

    def noted(scene: Scene, mesh: TetMesh, duration: float, quick: bool) -> Study:
        durations.append(duration / scene.recording.duration)
        return made("simulation_time")()

    monkeypatch.setattr(costs, "simulation_time_study", noted)
    command("cost", *SMALL, "studies=[simulation_time]", "motion_share=0.7")
    assert durations == pytest.approx([0.7])
    assert "No cheapest run" not in (page_of() / "findings.txt").read_text(), "of one study alone nobody expects it"


def test_named_command_is_the_run_that_was_studied(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    wide = Point("width 128", "60 s", 0.1, Timing.of([1.0]), overrides=("model.width=128",))
    studies = {name: made(name)() for name in STUDIES_OF_THE_WHOLE}
    studies["training"] = replace(studies["training"], points=(wide,))
    monkeypatch.setattr(costs, "_made", lambda bench, name: [studies[name]])
    monkeypatch.setattr(costs, "_write", lambda bench, output, found, summary, *rest: findings.append(summary))
    findings: list[list[str]] = []
    typed = ("+effect@dataset.scene.effects.weight=gravity", "dataset.scene.effects.weight.acceleration=[0,0,-1]", "data_folder=my data")
    command("cost", *SMALL, *typed, "precision=32-true", f"studies=[{','.join(STUDIES_OF_THE_WHOLE)}]", "wanted_mm=[0.5,0.1]")
    _, named, too_much, *_ = findings[-1]
    words = shlex.split(named)[2:]
    kept = [word for word in SMALL if word not in ("model.width=16", "quick=true")]
    assert words == [*kept, *typed, "trainer.precision=32-true", "model.width=128", "trainer.accelerator=cpu"]
    assert too_much == "0.1 mm: no time step, distances, training and grid that were measured are accurate enough."
    GlobalHydra.instance().clear()
    register("train")
    settings = frozen(composed("train", *words))
    assert (settings.dataset.scene.geometry.cells, settings.model.width, settings.data_folder) == (4, 128, "my data")
    assert "weight" in settings.dataset.scene.effects


def test_study_of_a_network_without_one_says_what_to_give(command: Command, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command("cost", *SMALL, "studies=[reconstruction]")
    assert "add training to studies, or give checkpoint=" in capfd.readouterr().err


def test_study_that_fails_stays_on_the_page_with_its_reason_and_the_others_go_on(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(costs, "simulation_time_study", refused)
    monkeypatch.setattr(costs, "distance_study", made("distances"))
    command("cost", *SMALL, "studies=[simulation_time,distances]")
    with (page_of() / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["failure"] for row in rows if row["study"] == "simulation_time"] == ["the scene cannot be run so; change it"]
    assert any(row["study"] == "distances" and not row["failure"] for row in rows)
    assert "Nothing could be measured: the scene cannot be run so; change it." in (page_of() / "findings.txt").read_text()


def test_page_is_written_after_each_study(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*given: object, **more: object) -> Study:
        raise KeyboardInterrupt

    monkeypatch.setattr(costs, "simulation_time_study", made("simulation_time"))
    monkeypatch.setattr(costs, "distance_study", killed)
    with pytest.raises((SystemExit, KeyboardInterrupt)):
        command("cost", *SMALL, "studies=[simulation_time,distances]")
    assert [study["name"] for study in json.loads((page_of() / "cost.json").read_text())["studies"]] == ["simulation_time"]


def test_command_of_which_every_study_failed_fails(command: Command, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(costs, "distance_study", refused)
    with pytest.raises(SystemExit):
        command("cost", *SMALL, "studies=[distances]")
    assert "found that each failed with the reason above" in capfd.readouterr().err
    assert "the scene cannot be run so" in (page_of() / "findings.txt").read_text()


def test_what_there_is_to_warn_of_a_prepared_scene_is_said_once(command: Command, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def planned(scene: Scene, mesh: TetMesh, *rest: object) -> Study:
        plan(scene, mesh)  # as every point does
        return made("simulation_time")()

    monkeypatch.setattr(costs, "simulation_time_study", planned)
    for _ in range(2):  # the first time the preparation says it too
        capfd.readouterr()
        command("cost", *SMALL, "studies=[simulation_time]")
    assert capfd.readouterr().out.count("outside linear elasticity: the load") == 1


def test_checkpoint_of_another_dataset_is_refused_before_anything_is_measured(command: Command, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    checkpoint = tmp_path / "last.ckpt"
    torch.save({RECORD: {"trajectory": "trajectory-0.h5", "distances": "distances-0.h5"}}, checkpoint)
    with pytest.raises(SystemExit):
        command("cost", *SMALL, "studies=[distances,queries]", f"checkpoint={checkpoint}")
    assert "found trajectory-0.h5, distances-0.h5; choose the dataset" in capfd.readouterr().err
    assert not list(Path("outputs/cost").rglob("report.html"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("checkpoint=.",), "checkpoint must be a file, found a folder at '.'"),
        (("checkpoint=nowhere.ckpt",), "checkpoint must be a file, found nothing at 'nowhere.ckpt'"),
        (("motion_share=1.5",), "motion_share must lie in (0, 1], found 1.5"),
        (("precision=8-bit",), "precision must be one of auto, bf16-mixed, 32-true; found '8-bit'"),
        (("studies=[distances,queries]",), "studies=queries needs a network, found none; add training to studies"),
    ],
)
def test_what_cannot_be_studied_is_refused_at_once(command: Command, capfd: pytest.CaptureFixture[str], words: tuple[str, ...], message: str) -> None:
    with pytest.raises(SystemExit):
        command("cost", *SMALL, *words)
    assert message in capfd.readouterr().err
    assert not Path("outputs/data").exists(), "nothing was prepared"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"studies": ("distances", "network")},
            "studies=network needs a network, found none; add training to studies, or give checkpoint=... or sweep_folder=",
        ),
        ({"studies": ("training", "queries"), "sweep_folder": "."}, "sweep_folder is read by studies=network, found training, queries; add one to studies"),
        ({"studies": ("distances",), "checkpoint": "."}, "checkpoint is read by studies=network or queries or reconstruction, found distances"),
        ({"studies": ("distances",), "motion_share": 0.5}, "motion_share is read by studies=simulation_time, found distances"),
    ],
)
def test_network_study_without_a_network_and_sweep_without_the_study_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        CostSettings(**{"dataset": BALL, "dataset_name": "ball", **settings})


def bench_of(data: Path, **settings: Any) -> Bench:
    """The bench of the ball."""
    return Bench(CostSettings(dataset=BALL, dataset_name="ball", data_folder=str(data), quick=True, **settings))


def trained(setting: str, *overrides: str) -> Trained:
    """A small network of the training study; without overrides the default."""
    model = ModelSettings(width=8, depth=1, latent=2, encoder_width=4, encoder_depth=1)
    return Trained(
        Networks(model, torch.zeros(2, 4, 3), torch.zeros(3), torch.ones(3)), Point("width 8", setting, is_default=not overrides, overrides=overrides)
    )


def sweep_of_one(folder: Path) -> Path:
    """A sweep with one finished job, which trained as the commands do when nothing is said."""
    result = {"decoder_parameters": 99, "query_bytes": 400, "chamfer_l1_mm_mean": 0.1, "chamfer_l1_mm_worst": 0.2, "train_seconds": 1.0}
    job = folder / "seed=1"
    job.mkdir(parents=True)
    (job / JOB_FILE).write_text(json.dumps({"overrides": ["seed=1"], "configuration": "x", "status": FINISHED, "reason": ""}))
    (job / RESULT_FILE).write_text(json.dumps({**result, "settings": described(TrainSettings(dataset=BALL))}))
    return folder


@pytest.mark.parametrize("given", ["training", "checkpoint", "sweep_folder"])
def test_networks_of_training_checkpoint_and_sweep_stand_beside_the_baselines(given: str, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint, sweep, arrived = tmp_path / "last.ckpt", sweep_of_one(tmp_path / "sweep"), list[Candidate]()
    checkpoint.touch()

    def recorded(candidates: list[Candidate], *rest: object) -> list[MeasuredShape]:
        arrived.extend(candidates)
        return []

    monkeypatch.setattr(costs, "measured_shapes", recorded)
    monkeypatch.setattr(costs, "networks_trained_on", lambda files, path: trained("given").networks)
    settings: dict[str, dict[str, Any]] = {
        "training": {"studies": ("training", "network")},
        "checkpoint": {"checkpoint": str(checkpoint)},
        "sweep_folder": {"sweep_folder": str(sweep)},
    }
    bench = bench_of(data, **{"studies": ("network",), **settings[given]})
    bench.trained = [trained("20 s", "training.seconds=20"), trained("1 epochs")] if given == "training" else []
    bench.network()
    count = f"{trained('').networks.decoder.parameter_count:,} parameters"
    expected = {
        "training": [(f"width 8, 20 s, {count}", False), (f"width 8, 1 epochs, {count}", True)],
        "checkpoint": [(f"the checkpoint, {count}", False)],
        "sweep_folder": [("(as it comes), 99 parameters", True)],
    }
    assert [(one.setting, one.is_default) for one in arrived if one.method == "network"] == expected[given]
    assert any(one.method != "network" for one in arrived)


def test_default_network_is_never_replaced_by_a_shorter_training(data: Path) -> None:
    bench = bench_of(data)
    with pytest.raises(ConfigurationError, match="found that no training went well; give checkpoint"):
        bench.network()
    default, short = trained("1 epochs"), trained("60 s", "training.seconds=60")
    bench.trained = [default, short]
    assert bench.networks is default.networks
    bench.trained = [short]
    with pytest.raises(ConfigurationError, match="no training of the default one went well; give checkpoint="):
        _ = bench.networks


def test_every_study_of_the_settings_is_one_that_can_be_made() -> None:
    assert all(callable(getattr(Bench, name)) for name in STUDIES)


def test_sweep_or_checkpoint_that_is_not_there_is_refused_before_anything_is_measured(command: Command, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command("cost", *SMALL, "sweep_folder=nowhere")
    assert "sweep_folder must be there, found nothing at 'nowhere'" in capfd.readouterr().err


def test_sweep_without_a_finished_job_is_refused_and_one_with_others_says_which(command: Command, capfd: pytest.CaptureFixture[str]) -> None:
    failed = Path("jobs/seed=0")
    failed.mkdir(parents=True)
    (failed / JOB_FILE).write_text(json.dumps({"overrides": ["seed=0"], "configuration": "x", "status": FAILED, "reason": "killed by SIGKILL"}))
    with pytest.raises(SystemExit):
        command("cost", *SMALL, "studies=[network]", "sweep_folder=jobs")
    assert "sweep_folder must hold finished jobs of a sweep, found none of 1 in 'jobs'" in capfd.readouterr().err
    sweep_of_one(Path("jobs"))
    assert [job.folder.name for job in _finished_jobs(Path("jobs"))] == ["seed=1"]
    assert "jobs/seed=0 is not among the networks, because it is failed: killed by SIGKILL" in capfd.readouterr().out


@pytest.mark.slow
def test_every_study_of_the_quick_command_is_measured(command: Command) -> None:
    command("cost", *SMALL)
    with (page_of() / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    measured = {row["study"] for row in rows if not row["failure"]}
    assert {"simulation_time", "simulation_space", "distances", "training", "network_query", "query_1", "reconstruction"} <= measured
    whole = next(line for line in (page_of() / "findings.txt").read_text().splitlines() if line.startswith("1 mm: "))
    assert "the whole motion, the training, and the distances and the reconstruction of every frame" in whole
