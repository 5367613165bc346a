"""What a user meets on the command line: one clear message for a mistake, no traceback, nothing half-written."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import trimesh
from hydra.core.global_hydra import GlobalHydra

import sdfnet.cli
from sdfnet.plugins import shipped

SMALL = ["dataset=sphere_squeeze", "dataset.scene.geometry.cells=3", "dataset.scene.effects.left.radius=0.03", "dataset.scene.effects.right.radius=0.03"]
SMALL += ["dataset.scene.recording.frames=3", "dataset.sampling.count=500", "dataset.sampling.near_surface_count=200", "data_folder=data"]
Outcome = tuple[int, str, str]  # exit code, standard output, standard error
Command = Callable[..., Outcome]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """Runs a command in this process, as its script does."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr("hydra._internal.utils.is_under_debugger", lambda: False)  # Hydra takes coverage's tracing for a debugger's

    def run(name: str, *arguments: str) -> Outcome:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        capfd.readouterr()
        code = 0
        try:
            getattr(sdfnet.cli, name)()
        except SystemExit as stop:
            if isinstance(stop.code, str):  # as the interpreter does
                print(stop.code, file=sys.stderr)  # noqa: T201
            code = stop.code if isinstance(stop.code, int) else 1
        out, err = capfd.readouterr()
        return code, out, err

    yield run
    GlobalHydra.instance().clear()


def _refusal(outcome: Outcome, *words: str) -> None:
    """Exit code, message and the absence of a traceback; no data but locks."""
    code, out, err = outcome
    assert code != 0
    assert "Traceback" not in out + err
    for word in words:
        assert word in err
    assert [path.name for path in Path().rglob("*") if path.is_file() and path.suffix in {".h5", ".vtu", ".mesh", ".xdmf", ".json", ".ckpt"}] == []


def test_prepare_makes_the_files_then_finds_them(command: Command) -> None:
    code, out, _ = command("prepare", *SMALL)
    assert code == 0
    assert re.search(r"simulation: data/trajectory-\w+\.h5 \(made, .*\nsigned distances: data/distances-\w+\.h5 \(made, ", out)
    code, out, _ = command("prepare", *SMALL)
    assert code == 0
    assert out.count("(was there, ") == 3


def test_plan_only_simulates_nothing(command: Command) -> None:
    code, out, _ = command("prepare", *SMALL, "plan_only=true")
    assert code == 0
    assert "step limits" in out
    assert not list(Path("data").glob("*.h5"))


def test_every_run_leaves_its_configuration(command: Command) -> None:
    command("prepare", *SMALL, "plan_only=true")
    (overrides,) = Path("outputs/prepare").glob("*/.hydra/overrides.yaml")
    assert "dataset=sphere_squeeze" in overrides.read_text()


def test_an_unknown_dataset_lists_the_known_ones(command: Command) -> None:
    outcome = command("prepare", "dataset=bunny_pok", "data_folder=data")
    _refusal(outcome, "Could not find 'dataset/bunny_pok'", "beam_bend", "bunny_poke", "sphere_squeeze")


@pytest.mark.parametrize(
    ("name", "override", "nearest"),
    [
        ("prepare", "dataset.scene.effects.lft.pressure=2", "left"),
        ("prepare", "dataset.scene.effects.left.presure=2", "pressure"),
        ("prepare", "dataset.smpling.count=2", "sampling"),
        ("train", "model.widht=64", "width"),
        ("train", "trainig.epochs=1", "training"),
        ("cost", "mesure=step", "measure"),
        ("evaluate", "chekpoint=a.ckpt", "checkpoint"),
    ],
)
def test_a_wrong_key_is_answered_with_the_nearest(command: Command, name: str, override: str, nearest: str) -> None:
    dataset = [] if name == "evaluate" else SMALL
    outcome = command(name, *dataset, override)
    _refusal(outcome, override.split("=")[0], f"Did you mean '{nearest}'?", "Known here: ")


@pytest.mark.parametrize(
    ("name", "override", "words"),
    [
        ("prepare", "dataset.scene.effects.left.pressure=hard", ["dataset.scene.effects.left.pressure=hard", "could not be converted to Float"]),
        ("prepare", "dataset.scene.geometry.cells=2.5", ["could not be converted to Integer"]),
        ("train", "training.epochs=many", ["could not be converted to Integer"]),
        ("train", "model.latent=null", ["model.latent", "not Optional"]),
        ("train", "trainer.progress_bar=7.5", ["not a valid bool", "progress_bar"]),
    ],
)
def test_a_wrong_type_is_named_without_a_guess_at_another_key(command: Command, name: str, override: str, words: list[str]) -> None:
    outcome = command(name, *SMALL, override)
    _refusal(outcome)
    assert all(word.lower() in outcome[2].lower() for word in words)
    assert "Did you mean" not in outcome[2]


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("prepare", "dataset.scene.material.poisson_ratio=0.5", "material.poisson_ratio must lie in (-1, 0.5), found 0.5"),
        ("prepare", "dataset.scene.solver.time_step=1.0", "stable limit"),
        ("prepare", "dataset.scene.geometry.cells=0", "geometry.cells must be at least 1 along every axis"),
        ("prepare", "dataset.scene.effects.left.center=[9,9,9]", "move poke.center there"),
        ("train", "split=none", "split must be one of all, interpolation, extrapolation; found 'none'"),
        ("cost", "measure=everything", "measure must be one of all, step, throughput; found 'everything'"),
    ],
)
def test_a_value_that_cannot_be_is_refused_in_the_settings_own_words(command: Command, name: str, override: str, message: str) -> None:
    code, out, err = command(name, *SMALL, override)
    assert code == 1
    assert "Traceback" not in out + err
    assert message in err
    assert not list(Path().rglob("*.h5"))


def test_an_override_without_a_value_is_explained(command: Command) -> None:
    _refusal(command("prepare", "dataset"), "Error parsing override 'dataset'", "missing EQUAL")


def test_a_missing_mesh_is_named(command: Command) -> None:
    outcome = command("prepare", "dataset.scene.geometry.path=nowhere.obj", "data_folder=data")
    _refusal(outcome, "no surface file at 'nowhere.obj'; give an existing .obj, .ply, .stl or .usd")


def test_an_open_mesh_is_named_with_its_open_edges_and_the_cure(command: Command) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export("open.ply")
    outcome = command("prepare", "dataset.scene.geometry.path=open.ply", "data_folder=data")
    _refusal(outcome, "'open.ply' must be a closed surface, found 3 open edges", "dataset.scene.geometry.repair=true")


def test_a_truncated_file_is_named_with_the_cure(command: Command) -> None:
    assert command("prepare", *SMALL)[0] == 0
    (trajectory,) = Path("data").glob("trajectory-*.h5")
    trajectory.write_bytes(trajectory.read_bytes()[:-500])
    before = sorted(Path("data").iterdir())
    code, out, err = command("prepare", *SMALL)
    assert code == 1
    assert "Traceback" not in out + err
    assert f"'{trajectory}' is truncated or not an HDF5 file of sdfnet" in err
    assert "delete it and it is made again" in err
    assert sorted(Path("data").iterdir()) == before


def test_a_file_of_another_version_is_named(command: Command) -> None:
    assert command("prepare", *SMALL)[0] == 0
    (distances,) = Path("data").glob("distances-*.h5")
    with h5py.File(distances, "a") as file:
        file.attrs["version"] = 99
    code, _, err = command("prepare", *SMALL)
    assert code == 1
    assert f"'{distances}' has format version 99" in err


def test_a_checkpoint_that_is_missing_or_no_checkpoint_is_named(command: Command) -> None:
    code, out, err = command("evaluate", "checkpoint=nowhere.ckpt")
    assert code == 1
    assert "Traceback" not in out + err
    assert "nowhere.ckpt" in err
    Path("letter.ckpt").write_text("dear friend")
    code, out, err = command("evaluate", "checkpoint=letter.ckpt")
    assert code == 1
    assert "Traceback" not in out + err
    assert "letter.ckpt" in err


def test_a_checkpoint_of_arrays_at_hand_is_not_measured_on_files(command: Command) -> None:
    torch.save({"sdfnet": {"train_frames": [0]}}, "notebook.ckpt")
    code, out, err = command("evaluate", "checkpoint=notebook.ckpt")
    assert code == 1
    assert "Traceback" not in out + err
    assert "'notebook.ckpt' was trained on arrays at hand, not on prepared files; measure it there with sdfnet.evaluation.evaluate" in err


def test_evaluate_without_a_checkpoint_asks_for_one(command: Command) -> None:
    _refusal(command("evaluate"), "these settings have no value yet: checkpoint; give each on the command line")


def test_a_broken_plugin_stops_every_command_with_its_path(command: Command) -> None:
    Path("datasets").mkdir()
    Path("datasets/mine.py").write_text("import nowhere_at_all")
    _refusal(command("prepare", *SMALL), "prepare: dataset plugin", "datasets/mine.py' failed to load: ModuleNotFoundError", "mend it or move it")


def test_a_sweep_runs_once_per_value_each_in_its_own_folder(command: Command) -> None:
    code, _, _ = command("prepare", *SMALL[1:5], "plan_only=true", "data_folder=data", "dataset=sphere_squeeze", "dataset.sampling.seed=1,2", "-m")
    assert code == 0
    assert len(list(Path().rglob(".hydra/overrides.yaml"))) == 2


def test_a_sweep_over_a_glob_of_datasets_reaches_hydra(command: Command) -> None:
    code, out, err = command("prepare", "dataset=glob(s*)", "plan_only=true", "data_folder=data", "-m")
    assert (code, err) == (0, "")
    assert "#0 : dataset=sphere_squeeze" in out


def test_a_mistake_in_a_sweep_is_explained_before_the_first_job(command: Command) -> None:
    _refusal(command("prepare", "dataset=sphere_squeeze", "dataset.sampling.sed=1,2", "-m"), "Did you mean 'seed'?")


def test_the_traceback_comes_when_it_is_asked_for(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(Exception, match="no surface file at 'nowhere.obj'"):
        command("prepare", "dataset.scene.geometry.path=nowhere.obj", "data_folder=data")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train", "prepare", "evaluate", "cost"])
def test_each_script_shows_its_settings_and_refuses_a_wrong_key(name: str) -> None:
    script = shipped("conf").parent / f"{name}.py"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    shown = subprocess.run([sys.executable, str(script), "--cfg", "job"], capture_output=True, text=True, env=environment, check=False)
    assert shown.returncode == 0, shown.stderr
    assert "data_folder: outputs/data" in shown.stdout
    wrong = subprocess.run([sys.executable, str(script), "data_foldr=x"], capture_output=True, text=True, env=environment, check=False)
    assert wrong.returncode == 1
    assert "Did you mean 'data_folder'?" in wrong.stderr
    assert "Traceback" not in wrong.stderr
