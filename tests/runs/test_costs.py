"""The cost command: studies that are asked for, one page, and a clear word where something is missing."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from sdfnet.cli import costs
from sdfnet.cli.costs import Bench
from sdfnet.cli.settings import STUDIES
from sdfnet.cost.studies import Point, Study, Timing
from sdfnet.errors import PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.models.networks import RECORD
from sdfnet.physics.plan import plan
from sdfnet.scene import Scene

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
    return lambda *given, **more: Study(
        name, name, name.title(), "error (mm)", "time (s)", (Point("quick", "as it comes", 0.1, Timing.of([1.0]), is_default=True),)
    )


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
    said = capfd.readouterr().out
    assert "What the time step costs" in said
    assert "python train.py" not in said, "no whole is told of two of its three studies"
    assert "What accuracy costs: sphere_squeeze" in (folder / "report.html").read_text()


def test_share_of_the_motion_that_is_run_is_the_one_that_was_asked_for(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    durations: list[float] = []

    def noted(scene: Scene, mesh: TetMesh, duration: float, quick: bool) -> Study:
        durations.append(duration / scene.recording.duration)
        return made("simulation_time")()

    monkeypatch.setattr(costs, "simulation_time_study", noted)
    command("cost", *SMALL, "studies=[simulation_time]", "motion_share=0.7")
    assert durations == pytest.approx([0.7])


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


def test_every_study_of_the_settings_is_one_that_can_be_made() -> None:
    assert all(callable(getattr(Bench, name)) for name in STUDIES)


def test_sweep_or_checkpoint_that_is_not_there_is_refused_before_anything_is_measured(command: Command, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command("cost", *SMALL, "sweep_folder=nowhere")
    assert "sweep_folder must be there, found nothing at 'nowhere'" in capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*does not have many workers.*", "ignore:.*LeafSpec.*")
def test_every_study_of_the_quick_command_is_measured(command: Command) -> None:
    command("cost", *SMALL)
    with (page_of() / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["stage"] for row in rows if not row["failure"]} == {"simulation", "distances", "training", "network", "reconstruction"}
    whole = next(line for line in (page_of() / "findings.txt").read_text().splitlines() if line.startswith("1 mm: "))
    assert "for the whole motion, the distances of every frame and the training" in whole
