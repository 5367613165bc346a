"""What a user meets on the command line: one clear message for a mistake, no traceback, nothing half-written."""

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import trimesh
from hydra.core.global_hydra import GlobalHydra

import sdfnet.cli
from sdfnet.cli.earlier_run import quoted, take_over
from sdfnet.errors import TrainingError
from sdfnet.models.networks import RECORD
from sdfnet.plugins import shipped
from sdfnet.training.module import SdfTraining

SMALL = ["dataset=sphere_squeeze", "dataset.scene.geometry.cells=3", "dataset.scene.effects.left.radius=0.03", "dataset.scene.effects.right.radius=0.03"]
SMALL += ["dataset.scene.recording.frames=3", "dataset.sampling.count=500", "dataset.sampling.near_surface_count=200", "data_folder=data"]
Outcome = tuple[int, str, str]  # exit code, standard output, standard error
Command = Callable[..., Outcome]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """Runs a command in this process, as its script does."""

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
    assert out.count("nothing holds the solid: it flies freely") == 1  # by the simulation, and not by the printed plan again
    code, out, _ = command("prepare", *SMALL)
    assert code == 0
    assert out.count("(was there, ") == 3
    assert out.count("nothing holds the solid: it flies freely") == 1


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
        ("cost", "studes=[distances]", "studies"),
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
        (
            "prepare",
            "dataset.scene.effects.left.pressure=hard",
            ["dataset.scene.effects.left.pressure=hard", "'hard' of type 'str' could not be converted to Float"],
        ),
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
        ("prepare", "dataset.scene.solver.time_step=1", "time step 1 s exceeds the stable limit"),
        ("prepare", "dataset.scene.geometry.cells=0", "geometry.cells must be at least 1 along every axis"),
        ("prepare", "dataset.scene.effects.left.center=[9,9,9]", "move poke.center there"),
        ("train", "split=none", "split must be one of all, interpolation, extrapolation; found 'none'"),
        ("cost", "studies=[everything]", "studies must be one of simulation_time, simulation_space, distances, "),
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


def test_an_absurd_load_is_refused_before_distances_are_measured(command: Command) -> None:
    outcome = command("prepare", *SMALL, "dataset.scene.effects.left.pressure=1e9")
    assert outcome[0] == 1
    assert re.search(r"Weaken the loads, which are \d\S* of Young's modulus, or shorten recording\.duration", outcome[2])
    assert not list(Path("data").glob("*.h5"))


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("prepare", ["dataset.scene.effects.left.center=[0,0]"], "dataset.scene.effects.left.center must have 3 values, found 2: [0.0, 0.0]"),
        ("prepare", ["+dataset.scene.foo=1"], "dataset.scene.foo must be a setting, found none of that name; known here: geometry, effects"),
        ("train", ["+foo=1"], "foo must be a setting, found none of that name; known here: dataset, model"),
        ("train", ["seed=-1"], "seed must lie in [0, 4294967295], found -1"),
        ("prepare", ["data_folder=/proc/nope"], "data_folder must be a folder that can be made, found '/proc/nope'"),
        ("prepare", ["hydra.run.dir=/proc/nope"], "hydra.run.dir must be a folder that can be made, found '/proc/nope'"),
        ("train", ["--experiment", "smoke"], "a setting is given without dashes and with =, found '--experiment'; say experiment=smoke"),
        ("train", ["--model.width=8"], "say model.width=8"),
        ("train", ["--sweep", "min_size"], "say sweep=min_size"),
        ("train", ["--strategy=latent_loss"], "say strategy=latent_loss"),
        ("train", ["target.objectives=[chamfer_l1_mm]", "seed=0,1", "-m"], "found 'chamfer_l1_mm'\nDid you mean 'chamfer_l1_mm_"),
        (
            "train",
            ["hydra.sweep.dir=run-${hydra.job.num}", "seed=0,1", "-m"],
            "hydra.sweep.dir must be one folder for all jobs, found one that is not known yet",
        ),
        ("train", ["resume=nope", "batch.frames_per_step=2"], "no checkpoint at 'nope'; give resume=outputs/"),
        ("train", ["resume="], "resume must name a checkpoint, found nothing behind it; say resume=outputs/"),
        ("train", ["model=learned", "split=interpolation"], "model.latents=learned needs split=all, found split=interpolation"),
        ("train", ["evaluation.storage=int4"], "evaluation.storage must be one of float32, fp16, int8; found 'int4'\nDid you mean 'int8'?"),
        ("prepare", ["dataset.sampling.seed=-1"], "sampling.seed must not be negative, found -1"),
        ("prepare", ["data_folder="], "data_folder must be a folder, found nothing behind it; name one, or leave data_folder out"),
        ("prepare", ["dataset=null"], "Config group override must be a string or a list"),
        ("prepare", ["dataset.scene.effects.left.center=1"], "A list is written in brackets and, because of the shell, in quotes: 'key=[1,2,3]'"),
        ("prepare", ["dataset.scene.effects.left.center=(0,0,0)"], "A list is written in brackets"),
        ("cost", ["studies=distances"], "A list is written in brackets"),
        ("prepare", ["+effect@dataset.scene.effects.left=gravity"], "There is a PressurePoke of that name already: give another name, and if need be remove"),
    ],
)
def test_a_mistake_is_answered_with_its_cure_and_leaves_no_folder(command: Command, name: str, words: list[str], message: str) -> None:
    outcome = command(name, *SMALL, *words)
    _refusal(outcome, message)
    assert not list(Path().rglob(".hydra"))


def test_an_effect_in_the_place_of_something_else_is_not_told_to_take_another_name(command: Command) -> None:
    outcome = command("prepare", *SMALL, "+effect@dataset.scene.material=gravity")
    _refusal(outcome, "Gravity is not a subclass of Material")
    assert "of that name already" not in outcome[2]


@pytest.mark.parametrize(
    ("name", "override", "nearest"),
    [
        ("prepare", "dataset=bunny_pok", "bunny_poke"),
        ("prepare", "dataset.scene.solver.integrator=leapfrg", "leapfrog"),
        ("train", "experiment=smok", "smoke"),
        ("train", "model.encoding=fourer", "fourier"),
        ("train", "split=interpolate", "interpolation"),
        ("verify", "case=cantilver", "cantilever"),
    ],
)
def test_a_wrong_choice_is_answered_with_the_nearest(command: Command, name: str, override: str, nearest: str) -> None:
    outcome = command(name, override, *(["data_folder=data"] if name != "verify" else []))
    _refusal(outcome, f"Did you mean '{nearest}'?")


def test_a_dataset_that_fails_is_named_with_its_file(command: Command) -> None:
    Path("datasets").mkdir()
    Path("datasets/mine.py").write_text("from sdfnet.plugins import dataset\n\n\n@dataset\ndef mine():\n    return 1 / 0\n")
    _refusal(command("prepare", *SMALL), "dataset 'mine' in '", "datasets/mine.py' failed: ZeroDivisionError: division by zero; mend it or move it out")


@pytest.mark.parametrize(
    ("name", "shown", "hidden"),
    [
        ("prepare", ["dataset: beam_bend, bunny_poke, sphere_squeeze", "effects.NAME: body_force", "plan_only: false"], ["experiment", "model:", "optimizer"]),
        ("cost", ["model: dense_grid, hash_grid, learned, modulated, paper", "studies:"], ["experiment"]),
        ("evaluate", ["checkpoint: ???", "resolution: 100"], ["experiment", "model:", "dataset", "What can be chosen"]),
        ("verify", ["case: all"], ["experiment", "model:", "dataset", "What can be chosen"]),
    ],
)
def test_help_lists_what_the_command_reads_and_nothing_else(command: Command, name: str, shown: list[str], hidden: list[str]) -> None:
    code, out, _ = command(name, "--help")
    assert code == 0
    assert [word for word in shown if word not in out] == []
    assert [word for word in hidden if word in out] == []


def test_a_missing_mesh_is_named(command: Command) -> None:
    outcome = command("prepare", "dataset.scene.geometry.path=nowhere.obj", "data_folder=data")
    _refusal(outcome, "no surface file at 'nowhere.obj'; give an existing .obj, .ply, .stl, .off or .usd")


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
    torch.save({"a": 1}, "weights.ckpt")
    torch.save({"settings": Path("x")}, "object.ckpt")
    for name in ("letter", "weights", "object"):
        code, out, err = command("evaluate", f"checkpoint={name}.ckpt")
        assert code == 1
        assert "Traceback" not in out + err
        assert f"'{name}.ckpt' is " in err
        assert "expected one written by train.py" in err
        assert "weights_only" not in err  # PyTorch's advice to run the file's code


def test_a_checkpoint_of_arrays_at_hand_is_not_measured_on_files(command: Command) -> None:
    torch.save({"sdfnet": {"train_frames": [0]}}, "notebook.ckpt")
    code, out, err = command("evaluate", "checkpoint=notebook.ckpt")
    assert code == 1
    assert "Traceback" not in out + err
    assert "'notebook.ckpt' was trained on arrays at hand, not on prepared files; measure it there with sdfnet.evaluation.evaluate" in err


def test_evaluate_without_a_checkpoint_asks_for_one(command: Command) -> None:
    _refusal(
        command("evaluate"),
        "these settings have no value yet: checkpoint: text (what train.py wrote, such as outputs/train/.../checkpoints/last.ckpt); give",
    )


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


@pytest.mark.parametrize("option", ["--help", "--cfg=job", "--info=config"])
def test_an_option_that_only_shows_something_starts_no_sweep(command: Command, option: str) -> None:
    code, out, _ = command("train", "sweep=min_size", option)
    assert code == 0
    assert "no job of the sweep" not in out
    assert not Path("outputs/sweep").exists()


def test_a_run_of_a_sweeps_page_goes_on_alone(command: Command) -> None:
    settings = Path("job/.hydra")
    settings.mkdir(parents=True)
    (settings / "overrides.yaml").write_text("[sweep=min_size, model.width=8, seed=1]")
    code, out, err = command("train", *SMALL, "batch.frames_per_step=2", "batch.stride=2", "resume=job/checkpoints/latest.ckpt")
    assert code == 1
    assert "taken from the run in job: sweep=min_size model.width=8 seed=1 hydra.mode=RUN" in out
    assert "no checkpoint at 'job/checkpoints/latest.ckpt'" in err  # of the one training that was asked for
    assert not Path("outputs/sweep").exists()


def test_a_checkpoint_from_before_a_setting_existed_is_not_refused_for_it(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    records: list[dict[str, Any]] = []
    resumable = SdfTraining.require_resumable

    def remember(module: SdfTraining, record: dict[str, Any]) -> None:
        records.append(module.identity())
        resumable(module, record)
        raise TrainingError("resumable")

    monkeypatch.setattr(SdfTraining, "require_resumable", remember)
    torch.save({RECORD: {}}, "empty.ckpt")
    assert "the checkpoint differs from this run in model" in command("train", *SMALL, "batch.frames_per_step=2", "batch.stride=2", "resume=empty.ckpt")[2]
    for name, value, verdict in (("grid_levels", None, "resumable"), ("width", 7, "model.width (7 there, ")):
        model = {key: known for key, known in records[0]["model"].items() if key != name} | ({} if value is None else {name: value})
        torch.save({RECORD: {**records[0], "model": model}}, "older.ckpt")
        assert verdict in command("train", *SMALL, "batch.frames_per_step=2", "batch.stride=2", "resume=older.ckpt")[2]


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


@pytest.mark.skipif(importlib.util.find_spec("optuna") is not None, reason="it is installed")
def test_search_without_optuna_says_what_to_install(command: Command) -> None:
    _refusal(command("train", "sweep=search"), "sweep=search needs Optuna, found that it is not installed: pip install 'sdfnet[search]'")


@pytest.mark.parametrize("folder", ["plain", "with = and , in it", "it's"])
def test_a_resumed_run_brings_its_settings_whatever_its_folder_is_called(monkeypatch: pytest.MonkeyPatch, folder: str) -> None:
    (Path(folder) / ".hydra").mkdir(parents=True)
    (Path(folder) / ".hydra/overrides.yaml").write_text("[model.width=8, seed=3]")
    resume = f"resume={quoted(Path(folder) / 'checkpoints/last.ckpt')}"
    monkeypatch.setattr(sys, "argv", ["train.py", resume, "seed=1"])
    take_over("train")
    assert sys.argv == ["train.py", "model.width=8", resume, "seed=1"]


@pytest.mark.parametrize("resume", [[], ["resume=null"], ["resume=a,b"], ["resume=[a"]])
def test_a_run_where_it_is_typed_is_no_earlier_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], resume: list[str]) -> None:
    Path(".hydra").mkdir()
    Path(".hydra/overrides.yaml").write_text("[model.width=8]")
    monkeypatch.setattr(sys, "argv", ["train.py", "seed=1", *resume])
    take_over("train")
    assert sys.argv == ["train.py", "seed=1", *resume]
    assert capsys.readouterr().out == ""
