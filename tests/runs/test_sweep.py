"""Sweeps: a job that fails or is killed is a row, what is finished is found again, and what was interrupted ends as if nothing had been."""

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import joblib
import pytest
import torch
from filelock import FileLock
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from sdfnet.cli import entry, sweep, sweep_process
from sdfnet.cli.earlier_run import quoted
from sdfnet.cli.settings import TrainerSettings, TrainSettings
from sdfnet.cli.sweep_plan import folder_name, require_objectives
from sdfnet.cost.sweep_table import Target, read_jobs, unplanned, write_plan
from sdfnet.data.prepare import PreparedFiles
from sdfnet.errors import ConfigurationError
from sdfnet.geometry.solids import ClosedSurface
from sdfnet.models.networks import RECORD
from sdfnet.stopping import Stopped
from tests.runs.resumable_run import BALL

TINY = [
    "experiment=smoke", "dataset.scene.geometry.cells=4", "training.epochs=6", "batch.steps_per_epoch=40",
    "evaluation.resolution=24", "evaluation.surface_samples=2000", "evaluation.volume_samples=2000", "evaluation.mesh_frames=[]",
]  # fmt: skip
SWEEP = [sys.executable, "-c", "from sdfnet.cli import train; train()", "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", *TINY]
PLUGIN = """
from dataclasses import dataclass
from sdfnet.geometry.solids import Sphere
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.plugins import dataset
from sdfnet.scene import Dataset, Recording, Sampling, Scene

@dataclass(frozen=True)
class Pull(BodyForce):
    '''An effect of the plugin's own.'''

@dataset
def pulled() -> Dataset:
    effects = {"pull": Pull(density=(0.0, 0.0, 50.0))}
    return Dataset(Scene(Sphere(radius=0.05, cells=4), effects, recording=Recording(duration=2e-3, frames=9)), Sampling(count=4000, near_surface_count=2000))
"""


def run_sweep(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*SWEEP, *words], capture_output=True, text=True, check=False)


def processes() -> list[int]:
    """The numbers of all processes."""
    return [int(number) for number in os.listdir("/proc") if number.isdigit()]


def is_of_this_test(number: int, word: bytes = b"") -> bool:
    """Whether another process works in this test's folder and was started with a word."""
    process = Path(f"/proc/{number}")
    try:
        return number != os.getpid() and word in (process / "cmdline").read_bytes() and (process / "cwd").resolve() == Path.cwd()
    except OSError:  # it has ended
        return False


def jobs_of(name: str) -> dict[str, dict[str, str]]:
    """The rows of a sweep's jobs.csv by the override that tells them apart."""
    (path,) = Path("outputs/sweep").glob(f"{name}*/jobs.csv")
    with path.open() as file:
        return {row["overrides"].removeprefix(" ".join(TINY)).strip(): row for row in csv.DictReader(file)}


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The folders of the jobs that were trained, of which only the results are made: the wider the better, 13 raises and 14 has no surface."""
    folders: list[str] = []

    def train(folder: Path, overrides: list[str], threads: int) -> None:
        folders.append(folder.name)
        (width,) = [int(override.split("=")[1]) for override in overrides if override.startswith("model.width=")]
        if width == 13:
            raise OSError("no room for a process")
        errors = {"chamfer_l1_mm_mean": 1 / width, "chamfer_l1_mm_worst": None if width == 14 else 2 / width}
        knn1 = {"knn1_chamfer_l1_mm_mean": 0.3, "knn1_chamfer_l1_mm_worst": 0.3}
        (folder / "result.json").write_text(json.dumps({"decoder_parameters": width**2, "query_bytes": width, "train_seconds": 1.0} | errors | knn1))

    monkeypatch.setattr(sweep, "train_in_a_process", train)
    return folders


def test_error_of_any_kind_is_a_row_with_its_traceback_in_the_log_and_the_other_jobs_go_on(
    command: Callable[..., None], trained: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="^1$"):
        command("train", *TINY, "model.width=0,13,16", "-m")
    assert len(trained) == 2
    rows = jobs_of("experiment-smoke")
    assert (rows["model.width=0"]["status"], rows["model.width=0"]["reason"]) == ("failed", "model.width must be at least 1, found 0")
    assert (rows["model.width=13"]["status"], rows["model.width=13"]["reason"]) == ("failed", "OSError: no room for a process")
    assert rows["model.width=16"]["status"] == "finished"
    (log,) = Path("outputs/sweep").rglob("training.log")
    assert "Traceback" in log.read_text()
    assert "smallest network as good as KNN-1 on the worst frame has 256 parameters" in capfd.readouterr().out


def test_overrides_after_the_option_belong_to_the_sweep_and_a_second_start_says_what_it_skips(
    command: Callable[..., None], trained: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    for found in ("finished: ", "finished already: "):
        command("train", *TINY, "-m", "model.width=8,16")
        said = capfd.readouterr().out
        assert said.count(found) == 2
        assert "and with more values and hydra.sweep.dir=outputs/sweep/" in said.replace("\n", " ")
    assert len(trained) == 2


def test_settings_that_are_refused_later_leave_what_has_finished(
    command: Callable[..., None], trained: list[str], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("train", *TINY, "trainer.accelerator=cuda", "model.width=8,16", "-m")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    command(*words)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    command(*words)
    assert [row["status"] for row in jobs_of("experiment-smoke").values()] == ["finished", "finished"]
    assert "trainer.accelerator=cuda needs a CUDA device, found none; use auto or cpu: what had finished is kept" in capfd.readouterr().out
    assert len(trained) == 2


def test_second_sweep_in_the_folder_of_one_that_runs_is_refused(command: Callable[..., None], trained: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    Path("here").mkdir()
    with FileLock("here/.lock"), pytest.raises(SystemExit, match="one sweep at a time can run in a folder, found one that runs in 'here'; wait for its end"):
        command("train", *TINY, "model.width=8,16", "hydra.sweep.dir=here", "-m")
    assert (trained, list(Path("here").glob("*.json"))) == ([], [])


def test_a_sweep_that_is_told_to_stop_waits_for_its_jobs_and_told_again_it_does_not(tmp_path: Path) -> None:
    seconds: list[float] = []

    def end_when_told() -> None:
        with FileLock(tmp_path / ".job.lock"):
            holds.set()
            while not (tmp_path / ".stop").exists():
                time.sleep(0.01)
            time.sleep(0.2)  # the step and its checkpoint
            seconds.append(time.monotonic())

    holds, job = Event(), Thread(target=end_when_told)
    job.start()
    holds.wait()
    with pytest.raises(Stopped, match="SIGINT"):
        sweep._stop_jobs(tmp_path, signal.SIGINT)
    assert [ended <= time.monotonic() for ended in seconds] == [True]
    job.join()
    with FileLock(tmp_path / ".job.lock"), pytest.raises(Stopped, match="SIGTERM"):
        sweep._stop_jobs(tmp_path, signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        sweep_process.require_going_on(tmp_path)


def test_option_that_hydra_does_not_have_begins_no_sweep(command: Callable[..., None], trained: list[str]) -> None:
    with pytest.raises(SystemExit, match="^2$"):
        command("train", *TINY, "model.width=8,16", "-m", "--parallel")
    assert not Path("outputs/sweep").exists()


def test_table_is_written_also_when_what_runs_the_jobs_fails(command: Callable[..., None], trained: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    run_job = sweep.run_job

    def fail_after_the_first(config: DictConfig) -> object:
        if trained:
            raise RuntimeError("the launcher is gone")
        return run_job(config)

    monkeypatch.setattr(sweep, "run_job", fail_after_the_first)
    with pytest.raises(SystemExit):
        command("train", *TINY, "model.width=12,16", "-m")
    rows = jobs_of("experiment-smoke")
    assert [rows[f"model.width={width}"]["status"] for width in (12, 16)] == ["finished", "not started"]


def test_what_a_sweep_no_longer_asks_for_is_named_and_not_counted(command: Callable[..., None], trained: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    command("train", *TINY, "model.width=8,12", "hydra.sweep.dir='a,b'", "-m")
    assert (len(trained), "2 of 2 jobs finished" in capfd.readouterr().out) == (2, True)
    command("train", *TINY, "model.width=12,20", "hydra.sweep.dir='a,b'", "-m")
    assert (len(trained), "2 of 2 jobs finished" in (out := capfd.readouterr().out)) == (3, True)  # 12 is found again
    assert "not counted, because this sweep does not ask for them: " in out


def test_folder_that_was_typed_with_a_time_in_it_is_one_folder_with_a_table(command: Callable[..., None], trained: list[str]) -> None:
    command("train", *TINY, "hydra.sweep.dir=sweep-${now:%H-%M-%S-%f}", "model.width=8,12", "-m")
    (table,) = Path().glob("sweep-*/jobs.csv")
    assert len(table.read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("widths", "objectives", "minimised"),
    [("8", "chamfer_l1_mm_mean", [0.125]), ("8,13,14", "chamfer_l1_mm_worst,decoder_parameters", [(0.25, 64.0), None, None])],
)
def test_sweeper_is_given_every_objective_or_none(
    command: Callable[..., None], trained: list[str], monkeypatch: pytest.MonkeyPatch, widths: str, objectives: str, minimised: list[object]
) -> None:
    run_job, returned = sweep.run_job, []
    monkeypatch.setattr(sweep, "run_job", lambda config: returned.append(run_job(config)))
    with pytest.raises(SystemExit) if None in minimised else nullcontext():
        command("train", *TINY, f"model.width={widths}", f"target.objectives=[{objectives}]", "-m")
    assert returned == minimised


@pytest.fixture
def start(trained: list[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """`start(seed)` runs a job if needed and returns its folder; its data are the files t.h5 and d.h5."""
    monkeypatch.setattr(sweep, "prepare", lambda dataset, folder: PreparedFiles(folder / "m.vtu", folder / "t.h5", folder / "d.h5"))

    def run(seed: int = 0) -> Path:
        folder = Path("sweep/job")
        folder.mkdir(parents=True, exist_ok=True)
        sweep._run_if_needed(TrainSettings(BALL, seed=seed), ["model.width=8"], folder, 1)
        return folder

    return run


def stopped(folder: Path, name: str, **record: str) -> Path:
    """The checkpoint of a job, of certain files; the job was stopped."""
    (folder / "checkpoints").mkdir(exist_ok=True)
    torch.save({RECORD: record}, folder / "checkpoints" / name)
    job = folder / "job.json"
    job.write_text(job.read_text().replace('"finished"', '"running"'))
    return folder / "checkpoints" / name


def test_a_job_goes_on_from_its_end_or_its_newest_checkpoint_and_its_reason_is_of_this_attempt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "echo")  # says what would be run
    assert "resume=" not in str(sweep_process.train_in_a_process(tmp_path, [], 1))
    for checkpoint in (tmp_path / "checkpoints" / "latest.ckpt", tmp_path / "checkpoints" / "last.ckpt"):
        checkpoint.parent.mkdir(exist_ok=True)
        checkpoint.touch()
        reason = sweep_process.train_in_a_process(tmp_path, [], 1)
        assert reason is not None
        assert reason.startswith(f"goes on from {checkpoint} -c ")
        assert reason.endswith(f" resume={checkpoint}")


def test_a_network_of_other_settings_is_kept_aside_and_the_job_is_trained_anew(
    start: Callable[..., Path], trained: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    stopped(start(), "last.ckpt", trajectory="t.h5", distances="d.h5")
    checkpoint = start() / "checkpoints" / "last.ckpt"
    assert checkpoint.is_file()  # the job goes on
    for place in (1, 2):
        start(seed=place)
        assert "job: its settings differ from those that made it: trained anew" in capfd.readouterr().out
        assert Path(f"sweep/earlier/job.{place}/result.json").is_file()
    assert not checkpoint.exists()
    assert len(trained) == 4
    assert (len(read_jobs(Path("sweep"))), unplanned(Path("sweep"))) == (1, [])  # what lies aside is no job


def test_a_job_whose_checkpoint_is_broken_or_of_data_that_were_made_again_begins_anew(
    start: Callable[..., Path], trained: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    stopped(start(), "latest.ckpt", trajectory="t.h5", distances="old.h5")
    stopped(start(), "latest.ckpt").write_bytes(b"half")
    assert "its data were made again since: t.h5, old.h5 then, t.h5, d.h5 now: trained anew" in capfd.readouterr().out
    start()
    assert "is not a whole checkpoint of sdfnet" in capfd.readouterr().out
    assert (len(trained), len(list(Path("sweep/earlier").iterdir()))) == (3, 2)


@pytest.mark.parametrize(("size", "reason"), [("decoder_parameters", "parameters are more than the 64"), ("query_bytes", "bytes are more than the 8")])
def test_larger_networks_than_one_that_is_good_enough_are_left_out(command: Callable[..., None], trained: list[str], size: str, reason: str) -> None:
    command("train", *TINY, "model.width=8,16", "target.skip_larger=true", f"target.size={size}", "-m")
    rows = jobs_of("experiment-smoke")
    assert [row["status"] for row in rows.values()] == ["finished", "left out"]
    assert reason in list(rows.values())[1]["reason"]
    assert len(trained) == 1


def test_what_cannot_win_is_told_by_the_size_that_the_target_names(tmp_path: Path) -> None:
    errors = {f"{prefix}chamfer_l1_mm_{frames}": 0.1 for prefix in ("", "knn1_") for frames in ("mean", "worst")}
    (tmp_path / "small").mkdir()
    (tmp_path / "small/job.json").write_text(json.dumps({"overrides": [], "configuration": "x", "status": "finished", "reason": ""}))
    (tmp_path / "small/result.json").write_text(json.dumps({"decoder_parameters": 10**9, "query_bytes": 10, "train_seconds": 1.0} | errors))
    targets = {size: Target(size=size, skip_larger=True) for size in ("decoder_parameters", "query_bytes")}
    reasons = {size: sweep._why_hopeless(TrainSettings(BALL, target=target), tmp_path) for size, target in targets.items()}
    assert reasons["decoder_parameters"] is None
    assert "bytes are more than the 10 of a network that is good enough already" in str(reasons["query_bytes"])


def test_the_cores_are_divided_between_the_jobs_that_can_run_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(joblib, "cpu_count", lambda: 8)
    write_plan(tmp_path, {"a": [], "b": []})
    assert [sweep._jobs_at_once(asked, tmp_path) for asked in (1, 4, -1)] == [1, 2, 2]
    write_plan(tmp_path, None)
    assert [sweep._jobs_at_once(asked, tmp_path) for asked in (1, 4, -1)] == [1, 4, 8]
    given: list[int] = []
    monkeypatch.setattr(sweep, "train_in_a_process", lambda folder, overrides, threads: given.append(threads))
    for threads in (None, 3):
        sweep._run_if_needed(TrainSettings(BALL, trainer=TrainerSettings(threads=threads)), [], tmp_path, 2)
    assert given == [4, 3]


def test_no_folder_needs_quotes_and_no_two_settings_share_one() -> None:
    settings = [
        ["sweep=min_size"],
        ["seed=-1"],
        ["x=1,2"],
        ["x=[1,2]"],
        ["x=1-2"],
        ["x=1=2"],
        ["x=1e-3"],
        ["~x"],
        ["x='ä b'"],
        ["x=[[1],2]"],
        ["a=1", "b=" + 200 * "2"],
        [],
    ]
    names = [folder_name(overrides) for overrides in settings]
    assert names[0] == "sweep-min_size"
    assert len(set(names)) == len(names)
    for name in names:
        assert OverridesParser.create().parse_override(f"checkpoint=outputs/sweep/{name}/last.ckpt").value() == f"outputs/sweep/{name}/last.ckpt"


def test_what_the_geometry_is_read_from_is_part_of_what_a_job_is(tmp_path: Path) -> None:
    surface = ClosedSurface(path=str(tmp_path / "mine.obj"))
    settings = TrainSettings(replace(BALL, scene=replace(BALL.scene, geometry=surface)))
    keys = []
    for contents in ("one", "one", "another"):
        (tmp_path / "mine.obj").write_text(contents)
        keys.append(settings.key)
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize("path", ["outputs/a/last.ckpt", "a=1,2/last.ckpt", "it's/last.ckpt", "1", "null", "a b/c", "/x[1]/y"])
def test_any_path_can_be_the_value_of_an_override(path: str) -> None:
    assert OverridesParser.create().parse_override(f"resume={quoted(Path(path))}").value() == path
    assert ("'" in quoted(Path(path))) == (path != "outputs/a/last.ckpt")


def test_what_is_printed_of_a_stopped_run_can_be_typed() -> None:
    checkpoint = Path("it's a=1,2/checkpoints/last.ckpt")
    checkpoint.parent.mkdir(parents=True)
    checkpoint.touch()
    said = entry._how_to_go_on("train", Path("it's a=1,2"), [])
    (override,) = shlex.split(said.removeprefix("go on with: python train.py "))
    assert OverridesParser.create().parse_override(override).value() == str(checkpoint)


def test_a_stopped_trial_of_an_earlier_search_fails_no_later_search(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, status in (("a", "running"), ("b", "left out")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "job.json").write_text(json.dumps({"overrides": [f"x={name}"], "configuration": "", "status": status, "reason": ""}))
    assert not sweep.finish(tmp_path, Target())
    assert sweep.finish(tmp_path, Target(), [tmp_path / "a"])
    assert "the same command tries more settings" in capfd.readouterr().out


def test_a_sweeper_is_told_a_direction_for_every_objective() -> None:
    composed = OmegaConf.create({"hydra": {"sweeper": {"direction": ["minimize", "minimize"]}}})
    with pytest.raises(ConfigurationError, match=r"as many entries as hydra\.sweeper\.direction, 2; found 1: chamfer_l1_mm_mean"):
        require_objectives(composed, Target())
    require_objectives(composed, Target(objectives=("chamfer_l1_mm_mean", "decoder_parameters")))
    require_objectives(OmegaConf.create({"hydra": {"sweeper": {"direction": "minimize"}}}), Target())


def test_the_reason_of_a_job_is_of_this_attempt_and_without_hydras_words() -> None:
    log = "Epoch 1\nError executing job with overrides: ['x=1']\nthe message\n\nSet the environment variable HYDRA_FULL_ERROR=1 for a complete stack trace.\n"
    assert sweep_process._reason(1, log) == "the message"
    assert sweep_process._reason(130, log) == "told to stop by SIGINT"
    assert sweep_process._reason(143, log) == "told to stop by SIGTERM"
    assert sweep_process._reason(3, "") == "exit code 3 without a word"


def test_stopped_sweep_prints_the_command_that_was_typed(
    command: Callable[..., None], trained: list[str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sweep, "train_in_a_process", lambda *arguments, **named: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(SystemExit, match="^130$"):
        command("train", *TINY, "model.width=8,12", "-m")
    out, err = capfd.readouterr()
    assert f"the same command goes on from there: {shlex.join(['python', 'train.py', *TINY, 'model.width=8,12', '-m'])}\n" in err
    assert "running: model.width=8: stopped, or still under way" in out


@pytest.mark.parametrize(("works_for", "parent", "ends"), [("self", 1, False), ("1", 1, False), ("999999999", 1, True), (None, 1, False)])
def test_only_a_launchers_process_ends_with_the_sweep_that_it_works_for(
    monkeypatch: pytest.MonkeyPatch, works_for: str | None, parent: int, ends: bool
) -> None:
    monkeypatch.delenv(sweep_process.SWEEP_PROCESS, raising=False)
    if works_for is not None:
        monkeypatch.setenv(sweep_process.SWEEP_PROCESS, str(os.getpid()) if works_for == "self" else works_for)
    codes: list[int] = []
    monkeypatch.setattr(os, "getppid", lambda: parent)  # 1 is who adopts a process whose parent is gone
    monkeypatch.setattr(os, "_exit", codes.append)
    with subprocess.Popen(["sleep", "60"]) as job:
        wait = job.wait
        monkeypatch.setattr(job, "wait", lambda timeout=None: wait(timeout and 0.05))
        sweep_process._wait(job)
        assert (codes, job.poll() is not None) == (([1], True) if ends else ([], False))
        job.kill()


def test_processes_of_a_sweep_know_the_plugins_and_a_job_that_fails_is_a_row_with_its_reason() -> None:
    Path("datasets").mkdir()
    Path("datasets/pulled.py").write_text(PLUGIN)
    words = [word for word in TINY if "cells" not in word]
    done = subprocess.run(
        [*SWEEP[:6], *words, "dataset=pulled", "batch.frames_per_step=4", "optimizer.decoder_rate=0.01,1e30"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, "Traceback" in done.stdout + done.stderr) == (1, False), done.stdout + done.stderr
    with next(Path("outputs/sweep").glob("*/jobs.csv")).open() as file:
        failed, finished = sorted(csv.DictReader(file), key=lambda row: row["status"])
    assert failed["status"] == "failed"
    assert failed["reason"].startswith("epoch 0, step")
    assert ": epoch 0, step" in done.stdout
    assert finished["status"] == "finished"
    assert float(finished["chamfer_l1_mm_mean"]) > 0
    (result,) = Path("outputs/sweep").rglob("result.json")
    assert "GPU available" not in (result.parent / "training.log").read_text(), "what Lightning says of every training"
    assert json.loads(result.read_text())["configuration"] == json.loads((result.parent / "job.json").read_text())["configuration"]  # both processes agree


@pytest.mark.slow
def test_sweep_killed_at_some_moment_and_started_again_ends_with_the_same_table() -> None:
    words = ["model.width=12,16,20", "training.epochs=20", "trainer.checkpoint_seconds=0.5"]
    numbers = ("status", "decoder_parameters", "chamfer_l1_mm_mean", "chamfer_l1_mm_worst", "hausdorff_mm_worst", "normal_degrees_mean")
    whole = run_sweep("data_folder=data", *words)
    assert whole.returncode == 0, whole.stdout + whole.stderr
    expected = {job: [row[name] for name in numbers] for job, row in jobs_of("experiment-smoke").items()}
    os.rename("outputs", "first_outputs")
    killed = subprocess.Popen([*SWEEP, "data_folder=data", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not list(Path("outputs/sweep").rglob("latest.ckpt")) and time.monotonic() < deadline:
        time.sleep(0.05)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert list(Path("outputs/sweep").rglob("latest.ckpt"))
    assert not list(Path("outputs/sweep").rglob("jobs.csv"))
    deadline = time.monotonic() + 30
    while (left := [number for number in processes() if is_of_this_test(number)]) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert left == []  # what the sweep had started has ended with it
    again = run_sweep("data_folder=data", *words)
    assert again.returncode == 0, again.stdout + again.stderr
    assert {job: [row[name] for name in numbers] for job, row in jobs_of("experiment-smoke").items()} == expected
    logs = "".join(path.read_text() for path in Path("outputs/sweep").rglob("training.log"))
    assert "goes on from outputs/sweep" in logs


@pytest.mark.slow
def test_trainings_of_a_sweep_that_is_told_to_stop_end_with_a_checkpoint() -> None:
    words = ["model.width=12,16", "training.epochs=2000", "trainer.checkpoint_seconds=1e9"]
    told = subprocess.Popen([*SWEEP, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 120
    while len(list(Path("outputs/sweep").rglob("events.out*"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(2)  # into the training
    told.send_signal(signal.SIGINT)
    out, _ = told.communicate()
    assert told.returncode == 130, out
    assert "the same command goes on from there" in out
    assert len(list(Path("outputs/sweep").rglob("latest.ckpt"))) == 2


@pytest.mark.slow
def test_search_goes_on_with_what_it_knows() -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="its sweeper comes with pip install 'sdfnet[search]'")
    search = [*SWEEP[:3], *TINY, "sweep=search", "hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=1", "hydra.sweep.dir=search"]
    for seed, jobs in ((0, 2), (0, 2), (1, 4)):  # a few trials of one seed are the same trials: what is finished is found again
        done = subprocess.run([*search, f"hydra.sweeper.sampler.seed={seed}"], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert f"{jobs} of {jobs} jobs finished" in done.stdout


@pytest.mark.slow
def test_killed_job_is_a_row_and_the_others_go_on() -> None:
    sweep = subprocess.Popen([*SWEEP, "model.width=12,16", "training.epochs=30", "hydra.launcher.n_jobs=1"], stdout=subprocess.PIPE, text=True)
    job = None
    deadline = time.monotonic() + 120
    while job is None and time.monotonic() < deadline:
        time.sleep(0.05)
        job = next((number for number in processes() if is_of_this_test(number, b"hydra.mode=RUN")), None)
    assert job is not None
    os.kill(job, signal.SIGKILL)
    out, _ = sweep.communicate()
    assert sweep.returncode == 1
    rows = jobs_of("experiment-smoke")
    assert [(row["status"], row["reason"]) for row in rows.values()] == [("failed", "killed by SIGKILL: out of memory?"), ("finished", "")]
    assert "failed: model.width=12: killed by SIGKILL: out of memory?" in out
