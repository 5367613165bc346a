"""A sweep's table: seeds summed up by the median, failed jobs kept, the smallest good network found by hand-made results."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from sdfnet.cost.sweep_report import command_of, sentences_of, table_of, write_tables
from sdfnet.cost.sweep_table import (
    FAILED,
    FINISHED,
    JOB_FILE,
    LEFT_OUT,
    NOT_STARTED,
    RESULT_FILE,
    RUNNING,
    Target,
    knee_of,
    read_job,
    read_jobs,
    rows_of,
    smallest_settled,
    unplanned,
    write_plan,
)
from sdfnet.errors import ConfigurationError


def result(parameters: int, mean: float | None, worst: float | None, knn1: float | None = 0.4) -> dict[str, Any]:
    return {
        "decoder_parameters": parameters,
        "query_bytes": 4 * parameters,
        "chamfer_l1_mm_mean": mean,
        "chamfer_l1_mm_worst": worst,
        "knn1_chamfer_l1_mm_mean": knn1,
        "knn1_chamfer_l1_mm_worst": knn1,
        "train_seconds": 10.0,
    }


def write_job(sweep: Path, overrides: list[str], found: dict[str, Any] | None, status: str = FINISHED, reason: str = "") -> None:
    folder = sweep / "_".join(overrides)
    folder.mkdir(parents=True)
    (folder / JOB_FILE).write_text(json.dumps({"overrides": overrides, "configuration": "x", "status": status, "reason": reason}))
    if found is not None:
        (folder / RESULT_FILE).write_text(json.dumps(found))


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Four widths; at width 16 one seed of three is good, at 32 two of three are; one job failed, one has no result yet."""
    worst = {8: (0.9, 0.9, 0.9), 16: (0.3, 0.5, 0.6), 32: (0.3, 0.35, 0.5), 64: (0.2, 0.2, 0.2)}
    for width, errors in worst.items():
        for seed, error in enumerate(errors):
            write_job(tmp_path, [f"model.width={width}", f"seed={seed}"], result(width**2, error / 2, error))
    write_job(tmp_path, ["model.width=128", "seed=0"], None, FAILED, "killed by SIGKILL: out of memory?")
    write_job(tmp_path, ["model.width=256", "seed=0"], None, RUNNING)
    return tmp_path


def test_smallest_network_is_judged_by_the_median_of_its_seeds_and_never_by_the_best(sweep: Path) -> None:
    rows = rows_of(read_jobs(sweep), Target())
    smallest = smallest_settled(read_jobs(sweep), Target())
    assert [row.decoder_parameters for row in rows] == [64, 256, 1024, 4096]
    assert smallest is not None
    assert smallest.setting == ("model.width=32",)
    assert (smallest.chamfer_l1_mm_worst, smallest.chamfer_l1_mm_worst_range, smallest.seeds) == (0.35, (0.3, 0.5), 3)


def test_target_of_its_own_and_mean_over_frames_choose_another_network(sweep: Path) -> None:
    by_mean = smallest_settled(read_jobs(sweep), Target(chamfer_l1_mm=0.26, frames="mean"))
    assert by_mean is not None
    assert by_mean.setting == ("model.width=16",)
    assert smallest_settled(read_jobs(sweep), Target(chamfer_l1_mm=0.01)) is None


def test_smallest_may_be_told_by_its_bytes_so_that_fewer_bits_and_shorter_latents_win(tmp_path: Path) -> None:
    write_job(tmp_path, ["evaluation.storage=float32"], result(64, 0.1, 0.2))
    write_job(tmp_path, ["evaluation.storage=int8"], result(64, 0.2, 0.3) | {"query_bytes": 80})
    write_job(tmp_path, ["model.width=16", "evaluation.storage=int8"], result(256, 0.1, 0.1) | {"query_bytes": 100})
    found = {size: rows_of(read_jobs(tmp_path), Target(size=size)) for size in ("decoder_parameters", "query_bytes")}
    assert [row.query_bytes for row in found["decoder_parameters"]] == [256, 80, 100]
    assert [row.query_bytes for row in found["query_bytes"]] == [80, 100, 256]
    smallest = smallest_settled(read_jobs(tmp_path), Target(size="query_bytes"))
    assert smallest is not None
    assert smallest.setting == ("evaluation.storage=int8",)
    console = Console(width=200, file=io.StringIO())
    console.print(table_of(read_jobs(tmp_path), Target(size="query_bytes")))
    front = [line for line in console.file.getvalue().splitlines() if "front" in line]  # type: ignore[attr-defined]
    assert len(front) == 2  # the third has more bytes and more error


def test_frame_without_a_surface_is_an_infinite_error_and_not_a_good_one(tmp_path: Path) -> None:
    write_job(tmp_path, ["model.width=8"], result(64, None, None))
    (row,) = rows_of(read_jobs(tmp_path), Target())
    assert row.chamfer_l1_mm_worst == float("inf")
    assert not row.is_within_target
    write_tables(tmp_path, read_jobs(tmp_path), Target())

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    written = json.loads((tmp_path / "sweep.json").read_text(), parse_constant=refuse)
    assert written["rows"][0]["chamfer_l1_mm_worst"] is None
    assert written["rows"][0]["chamfer_l1_mm_worst_range"] == [None, None]


def test_table_says_no_surface_and_shows_settings_in_brackets(tmp_path: Path) -> None:
    write_job(tmp_path, ["strategy=[latent_32,fourier]", "seed=0"], result(64, 0.1, 0.2))
    write_job(tmp_path, ["strategy=[latent_32,fourier]", "seed=1"], result(64, None, None))
    write_job(tmp_path, ["strategy=[]"], result(64, None, None))
    jobs, console = read_jobs(tmp_path), Console(width=200, file=io.StringIO())
    console.print(table_of(jobs, Target()))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "strategy=[latent_32,fourier]" in shown
    assert "(0.100 to no surface)" in shown
    assert shown.count("no surface") == 4 + 2  # of the mean and of the worst frame: the highest and the median of one setting, both of the other as one
    assert "the best has no surface in some frame with 64 parameters" in "\n".join(sentences_of(jobs, Target(chamfer_l1_mm=0.01)))


def test_without_a_surface_of_knn1_there_is_no_target_and_the_sentence_asks_for_one(tmp_path: Path) -> None:
    write_job(tmp_path, ["model.width=8"], result(64, 0.1, 0.2, knn1=None))
    jobs = read_jobs(tmp_path)
    assert smallest_settled(jobs, Target()) is None
    assert "KNN-1 has no surface in some frame, so there is nothing to be as good as: set target.chamfer_l1_mm" in sentences_of(jobs, Target())[0]
    assert smallest_settled(jobs, Target(chamfer_l1_mm=0.3)) is not None


def test_only_what_a_sweep_asks_for_is_counted_and_what_it_has_not_begun_is_not_passed_over(sweep: Path) -> None:
    asked = [[f"model.width={width}", f"seed={seed}"] for width in (64, 512) for seed in (0, 1, 2)]
    write_plan(sweep, {"_".join(overrides): overrides for overrides in asked})
    jobs = read_jobs(sweep)
    assert [list(job.overrides) for job in jobs] == asked  # in the order of the sweep, not of the names
    assert [job.status for job in jobs] == 3 * [FINISHED] + 3 * [NOT_STARTED]
    smallest = smallest_settled(jobs, Target())
    assert smallest is not None
    assert smallest.setting == ("model.width=64",)
    assert "model.width=32_seed=0" in (left := unplanned(sweep))
    assert len(left) == 11
    assert "3 of 6 jobs finished" in sentences_of(jobs, Target())[0]
    write_plan(sweep, None)  # of a sweeper that chooses as it goes
    assert len(read_jobs(sweep)) == 14
    assert unplanned(sweep) == []


@pytest.mark.parametrize("status", [RUNNING, FAILED, LEFT_OUT, NOT_STARTED])
def test_a_lucky_seed_leaves_no_larger_network_out_before_the_others_of_its_row_are_done(sweep: Path, status: str) -> None:
    settled = smallest_settled(read_jobs(sweep), Target())
    assert settled is not None
    assert settled.setting == ("model.width=32",)
    write_job(sweep, ["model.width=4", "seed=0"], result(16, 0.1, 0.1))
    overrides = ["model.width=4", "seed=1"]
    if status == NOT_STARTED:
        write_plan(sweep, {job.folder.name: job.overrides for job in read_jobs(sweep)} | {"_".join(overrides): overrides})
    else:
        write_job(sweep, overrides, None, status)
    jobs = read_jobs(sweep)
    assert smallest_settled(jobs, Target()) == settled
    said = "\n".join(sentences_of(jobs, Target()))
    assert "The smallest network as good as KNN-1 on the worst frame has 1,024 parameters" in said
    assert "model.width=4 may do with 16 parameters, 0.1 kB with the latents: 1 of 2 seeds finished." in said
    console = Console(width=200, file=io.StringIO())
    console.print(table_of(jobs, Target()))
    (marked,) = [line for line in console.file.getvalue().splitlines() if "smallest" in line]  # type: ignore[attr-defined]
    assert "model.width=32" in marked
    write_tables(sweep, jobs, Target())
    assert "model.width=32" in json.loads((sweep / "sweep.json").read_text())["smallest"]


def test_a_lucky_seed_is_no_knee(sweep: Path) -> None:
    before = knee_of(read_jobs(sweep), Target())
    write_job(sweep, ["model.width=9", "seed=0"], result(81, 0.01, 0.01))
    bend = knee_of(read_jobs(sweep), Target())
    assert bend is None
    assert before is not None
    write_job(sweep, ["model.width=9", "seed=1"], None, FAILED)
    assert knee_of(read_jobs(sweep), Target()) == before


def test_where_nothing_is_settled_no_network_is_called_the_smallest(tmp_path: Path) -> None:
    write_job(tmp_path, ["model.width=4", "seed=0"], result(16, 0.1, 0.1))
    write_job(tmp_path, ["model.width=4", "seed=1"], None, RUNNING)
    _, *said = sentences_of(read_jobs(tmp_path), Target())
    assert said[0] == "1 of 2 jobs finished; of none that is as good as KNN-1 on the worst frame every seed finished."
    assert said[1] == "model.width=4 may do with 16 parameters, 0.1 kB with the latents: 1 of 2 seeds finished."


def test_jobs_asked_for_with_another_target_or_data_folder_are_of_one_row(tmp_path: Path) -> None:
    write_job(tmp_path, ["model.width=4", "seed=0", "target.frames=mean", "data_folder=a"], result(16, 0.1, 0.1))
    write_job(tmp_path, ["model.width=4", "seed=1"], result(16, 0.2, 0.2))
    write_job(tmp_path, ["model.width=8", "seed=0", "target.frames=worst"], None, FAILED, "why")
    jobs = read_jobs(tmp_path)
    (row,) = rows_of(jobs, Target())
    assert (row.setting, row.seeds) == (("model.width=4",), 2)
    assert sentences_of(jobs, Target())[0] == "failed: model.width=8 seed=0: why"


def test_jobs_that_failed_or_never_finished_stay_in_table_and_file_with_their_reason(sweep: Path) -> None:
    jobs = read_jobs(sweep)
    write_tables(sweep, jobs, Target())
    with (sweep / "jobs.csv").open() as file:
        written = {row["overrides"]: row for row in csv.DictReader(file)}
    assert len(written) == 14
    assert written["model.width=128 seed=0"]["reason"] == "killed by SIGKILL: out of memory?"
    assert written["model.width=256 seed=0"]["status"] == RUNNING
    console = Console(width=200, file=io.StringIO())
    console.print(table_of(jobs, Target()))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert sentences_of(jobs, Target())[0] == "failed: model.width=128 seed=0: killed by SIGKILL: out of memory?"
    assert "0.350 (0.300 to 0.500)" in shown


def test_result_that_was_lost_makes_its_job_unfinished(sweep: Path) -> None:
    (sweep / "model.width=8_seed=0" / RESULT_FILE).unlink()
    (job,) = [job for job in read_jobs(sweep) if job.overrides == ("model.width=8", "seed=0")]
    assert job.status == RUNNING
    assert job.result is None
    assert job.reason == "its result.json is missing or broken"


def test_result_that_is_broken_makes_its_job_unfinished_and_a_broken_job_is_not_started(sweep: Path) -> None:
    (sweep / "model.width=8_seed=0" / RESULT_FILE).write_text('{"decoder_para')
    assert read_job(sweep / "model.width=8_seed=0").status == RUNNING
    (sweep / "model.width=8_seed=1" / JOB_FILE).write_text("")
    assert read_job(sweep / "model.width=8_seed=1").status == NOT_STARTED
    assert read_job(sweep / "model.width=9999").status == NOT_STARTED


def test_a_job_that_was_stopped_says_so_in_its_row(sweep: Path) -> None:
    assert "running: model.width=256 seed=0: stopped, or still under way" in sentences_of(read_jobs(sweep), Target())


def test_jobs_of_different_versions_are_told_apart(sweep: Path) -> None:
    assert "versions" not in "\n".join(sentences_of(read_jobs(sweep), Target()))
    for width, version in ((8, "2.1"), (16, "2.2")):
        versions = {"versions": {"torch": version, "numpy": "2.0"}}
        (sweep / f"model.width={width}_seed=0" / RESULT_FILE).write_text(json.dumps(result(width**2, 0.4, 0.9) | versions))
    assert sentences_of(read_jobs(sweep), Target())[-1] == "The jobs ran with different versions, and may differ for that alone: torch 2.1, torch 2.2."


def test_jobs_of_one_dataset_trained_on_different_files_are_told_apart(sweep: Path) -> None:
    for width, dataset, distances in ((8, "a", "old"), (16, "a", "new"), (32, "b", "of b")):
        files = {"settings": {"dataset": {"name": dataset}}, "files": {"trajectory": "one", "distances": distances}}
        (sweep / f"model.width={width}_seed=0" / RESULT_FILE).write_text(json.dumps(result(width**2, 0.4, 0.9) | files))
    said = "The jobs were trained on different files of the same dataset, and may differ for that alone: new, old."
    assert sentences_of(read_jobs(sweep), Target())[-1] == said


@pytest.mark.parametrize(("seconds", "is_said"), [(90.0, True), (None, False)])
def test_jobs_that_seconds_ended_on_other_threads_are_told_apart(sweep: Path, seconds: float | None, is_said: bool) -> None:
    for width, threads in ((8, 1), (16, 2)):
        settings = {"settings": {"training": {"seconds": seconds}}, "threads": threads}
        (sweep / f"model.width={width}_seed=0" / RESULT_FILE).write_text(json.dumps(result(width**2, 0.4, 0.9) | settings))
    said = "Seconds end these trainings, and they had different threads, so that their steps differ: 1, 2."
    assert (said in sentences_of(read_jobs(sweep), Target())) == is_said


def test_sentences_name_the_smallest_its_command_and_the_knee(sweep: Path) -> None:
    jobs = read_jobs(sweep)
    text = "\n".join(sentences_of(jobs, Target()))
    assert "12 of 14 jobs finished" in text
    assert "1,024 parameters" in text
    assert "python train.py model.width=32 seed=1" in text.splitlines()[-2]  # the seed whose error is the median
    bend = knee_of(jobs, Target())
    assert bend is not None
    assert f"The knee is at {bend.decoder_parameters:,} parameters" in text
    assert "the best has 0.200 mm with 4,096 parameters" in "\n".join(sentences_of(jobs, Target(chamfer_l1_mm=0.01)))
    assert "no job finished" in "\n".join(sentences_of([job for job in jobs if job.result is None], Target()))


def test_sentences_say_that_there_is_no_knee_and_what_has_no_surface(tmp_path: Path) -> None:
    for width, worst in ((8, 0.4), (16, 0.2), (32, None)):
        write_job(tmp_path, [f"model.width={width}"], result(width**2, worst, worst) | {"failed_frames": 3 if worst is None else 0})
    said = sentences_of(read_jobs(tmp_path), Target())
    assert any(sentence.startswith("There is no knee: ") for sentence in said)
    assert "Without a surface in some frames: model.width=32 (3); what each gives there is in its training.log." in said


def test_bytes_lead_where_they_decide_and_the_mean_is_over_the_frames(sweep: Path) -> None:
    said = "\n".join(sentences_of(read_jobs(sweep), Target(size="query_bytes", frames="mean", chamfer_l1_mm=0.26)))
    assert "The smallest network as good as 0.26 mm on average over the frames has 1.0 kB with the latents, 256 parameters: " in said


def test_command_quotes_what_a_shell_would_change() -> None:
    assert command_of(["model.width=8", "strategy=[a,b]"]) == "python train.py model.width=8 'strategy=[a,b]'"


def test_command_of_a_job_of_a_sweeps_page_runs_the_job_alone() -> None:
    assert command_of(["sweep=min_size", "model.width=8", "seed=2"]) == "python train.py sweep=min_size model.width=8 seed=2 hydra.mode=RUN"


def test_command_trains_on_as_many_threads_as_the_job_had(sweep: Path) -> None:
    for seed, threads in ((0, 7), (1, 3), (2, 7)):
        (sweep / f"model.width=32_seed={seed}" / RESULT_FILE).write_text(
            json.dumps(result(1024, 0.1, 0.3 + seed / 100) | {"threads": threads, "settings": {"training": {"seconds": None}}})
        )
    assert "Train it again: python train.py model.width=32 seed=1 trainer.threads=3" in sentences_of(read_jobs(sweep), Target())
    assert command_of(["trainer.threads=2"], 2) == "python train.py trainer.threads=2"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"frames": "all"}, "worst, mean"),
        ({"chamfer_l1_mm": 0.0}, "must be positive"),
        ({"objectives": ()}, "at least one"),
        ({"size": "kB"}, "target.size must be one of decoder_parameters, query_bytes; found 'kB'"),
        ({"objectives": ("chamfer_l1_mm_mean", "chamfer_mm")}, "must be one of decoder_parameters, .*chamfer_l1_mm_worst, .*; found 'chamfer_mm'"),
    ],
)
def test_wrong_targets_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Target(**wrong)
