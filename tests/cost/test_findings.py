"""Sentences and the cheapest whole, on points whose answer can be seen."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from sdfnet.cost import studies
from sdfnet.cost.findings import cheapest_whole, findings_of, front_of, unmeasured
from sdfnet.cost.studies import BYTES, EXACT_MM, Point, Study, Timing, duration_text, interleaved


def point(error: float | None, seconds: float | None, setting: str = "s", **more: object) -> Point:
    return Point("method", setting, error, None if seconds is None else Timing.of([seconds]), **more)  # type: ignore[arg-type]


def study(name: str, *points: Point, share_of_whole: float = 1.0) -> Study:
    return Study(name, name.title(), "error (mm)", "seconds", points, share_of_whole)


def test_front_leaves_out_failed_and_unmeasured_points() -> None:
    good = point(0.1, 1.0)
    assert front_of(study("training", good, point(None, 0.5), point(0.2, None), point(0.01, 0.01, failure="not installed"))) == [good]


def test_findings_give_the_slope_of_a_power_law_and_say_when_the_default_is_beaten() -> None:
    line = [point(10.0**-digit, 3.0**digit, f"digit {digit}") for digit in range(4)]
    beaten = point(0.05, 30.0, "asked for", is_default=True)
    text = " ".join(findings_of(study("simulation", *line, beaten, point(None, None, failure="refused"))))
    assert "a tenth of the error costs 3 times the time" in text
    assert "is beaten by method, digit 2 (0.01 mm, 9 s): 3.3 times quicker and no less accurate" in text
    assert "1 of 6 points failed" in text
    noisy = replace(beaten, seconds=Timing.of([8.0, 10.0, 12.0]))
    assert "The default, method, asked for (0.05 mm, 10 s), is as quick as method, digit 2 (0.01 mm, 9 s), which is no less accurate." in findings_of(
        study("simulation", *line, noisy)
    )
    as_small = replace(point(0.05, None, "asked for", is_default=True), bytes=1000, cost=BYTES)
    smaller = replace(point(0.01, None, "other"), bytes=990, cost=BYTES)
    assert "is as small as method, other (0.01 mm, 990 bytes), which is no less accurate." in " ".join(findings_of(study("network", as_small, smaller)))
    assert "The default is on the front: method, digit 1" in " ".join(
        findings_of(study("simulation", line[0], point(0.1, 3.0, "digit 1", is_default=True), line[2]))
    )


def test_study_in_which_everything_failed_says_why() -> None:
    assert findings_of(study("distances", point(None, None, failure="not installed"))) == ["Nothing could be measured: not installed."]


SIMULATION = study("simulation_time", point(0.01, 10.0, is_default=True), point(0.3, 1.0, overrides=("a=1",)))
DISTANCES = study("distances", point(1e-3, 2.0, is_default=True))
TRAINING = study("training", point(0.1, 100.0, overrides=("b=2",)), point(0.5, 10.0, is_default=True))
GRID = study("reconstruction", point(0.02, 0.3, is_default=True, overrides=("c=3",)), point(0.02, 0.1, "whole grid"), share_of_whole=0.1)
STUDIES = (SIMULATION, DISTANCES, TRAINING, GRID)


def test_cheapest_whole_adds_errors_and_seconds_of_one_point_of_each_study_and_the_seconds_of_the_mesh() -> None:
    found = cheapest_whole(STUDIES[::-1], 0.45, 7.0)
    assert found is not None
    assert [one.pair for one in found.points] == [(0.3, 1.0), (1e-3, 2.0), (0.1, 100.0), (0.02, pytest.approx(3.0))]
    assert (found.error_mm, found.seconds) == (pytest.approx(0.421), pytest.approx(113.0))
    assert found.overrides == ["a=1", "b=2", "c=3"]
    assert "113 s for the tet mesh (7 s), the whole motion" in found.words()
    assert "root mean square displacement: method, s (0.3 mm, 1 s); root mean square distance: method, s (0.001 mm, 2 s)" in found.words()
    assert "mean distance error within 1 % of the diagonal: method, s (0.1 mm, 100 s); chamfer L1: method, s (0.02 mm, 3 s)." in found.words()
    too_much = cheapest_whole(STUDIES, 0.05, 7.0)
    assert too_much is not None
    assert "0.05 mm: no time step, distances, training and grid that were measured are accurate enough" in too_much.words()


def test_cheapest_whole_says_what_a_study_of_a_part_measured() -> None:
    of_a_part = replace(SIMULATION, part="Errors are those of the first ms.")
    found = cheapest_whole([of_a_part, *STUDIES[1:]], 0.45, 7.0)
    assert found is not None
    assert found.words().endswith("(0.02 mm, 3 s). simulation_time: Errors are those of the first ms.")
    assert "Errors are those of the first ms." in findings_of(of_a_part)


def test_cheapest_whole_leaves_out_a_training_whose_network_had_no_surface() -> None:
    before = cheapest_whole(STUDIES, 0.45, 7.0)
    assert before is not None
    trained = before.points[2]
    lost = Point("network", "as trained", failure="no surface", overrides=trained.overrides, is_default=trained.is_default)
    found = cheapest_whole([*STUDIES, study("network_frame", lost)], 0.45, 7.0)
    assert found is not None
    assert lost.overrides not in [one.overrides for one in found.points]
    for other in (replace(lost, method="KNN-1"), replace(lost, is_default=not trained.is_default)):  # the latter is a checkpoint that was given
        assert cheapest_whole([*STUDIES, study("network_frame", other)], 0.45, 7.0) == before


def test_error_of_the_tet_mesh_is_told_beside_the_sum_where_it_was_measured() -> None:
    quadratic = point(0.0, 9.0, "P2", is_reference=True, is_default=True)
    found = [cheapest_whole([*STUDIES, study("simulation_space", *own, quadratic)], 0.45, 7.0) for own in ((), (point(0.2, 1.0, is_default=True),))]
    assert [one is not None and "quadratic tets by 0.2 mm (simulation_space), which is not among them" in one.words() for one in found] == [False, True]
    assert found[0] is not None
    assert "Their errors sum to 0.421 mm. root mean square" in found[0].words()


def test_whole_has_the_seconds_of_the_whole_run_and_not_of_the_part_that_was_studied() -> None:
    million = replace(DISTANCES, share_of_whole=1 / 131.3)
    found = cheapest_whole([SIMULATION, million, TRAINING, GRID], 0.45, 0.0)
    assert found is not None
    assert [one.pair[1] for one in found.points] == pytest.approx([1.0, 262.6, 100.0, 3.0])
    assert "367 s for the tet mesh" in found.words()
    assert "(0.001 mm, 263 s)" in found.words()


def test_whole_chooses_nothing_that_no_command_can_be_told_to_do() -> None:
    library = study("distances", point(0.0, 0.1, "a library"), point(1e-3, 2.0, "ours", is_default=True))
    found = cheapest_whole([SIMULATION, library, TRAINING, GRID], 0.45, 0.0)
    assert found is not None
    assert found.points[1].setting == "ours"
    assert found.points[3].setting == "s", "the whole grid is quicker and cannot be asked for"


def test_whole_keeps_the_default_where_another_setting_saves_next_to_nothing() -> None:
    default = point(0.001, 1.5, "leapfrog", is_default=True)
    for quicker, chosen in ((1.0, "leapfrog"), (0.1, "other")):  # of a whole of 106 s
        found = cheapest_whole([study("simulation_time", default, point(0.3, quicker, "other", overrides=("a=1",))), DISTANCES, TRAINING, GRID], 0.45, 0.0)
        assert found is not None
        assert found.points[0].setting == chosen


@pytest.mark.parametrize("missing", STUDIES)
def test_whole_is_not_told_of_a_part_of_its_studies(missing: Study) -> None:
    failed = replace(missing, points=(point(None, None, failure="refused", is_default=True),))
    for place in ((), (failed,)):
        found = [*place, *(one for one in STUDIES if one is not missing)]
        assert cheapest_whole(found, 0.45, 0.0) is None
        assert unmeasured(found) == [missing.name]


def test_reference_is_on_no_front_and_in_no_fit() -> None:
    line = [point(10.0**-digit, 3.0**digit, f"digit {digit}") for digit in range(4)]
    with_reference = study("distances", *line, point(0.0, 1e6, "reference", is_reference=True, is_default=True))
    assert front_of(with_reference) == line[::-1]
    assert findings_of(with_reference) == findings_of(study("distances", *line))
    alone = study("distances", point(0.0, 1.0, is_reference=True))
    assert findings_of(alone) == ["Nothing could be measured: there is the reference alone."]


def test_study_of_bytes_is_told_in_bytes() -> None:
    sizes = [Point("method", f"size {size}", 1 / size, bytes=size, cost=BYTES) for size in (1, 10, 100)]
    worse = Point("method", "default", 0.2, bytes=30, is_default=True, cost=BYTES)
    text = " ".join(findings_of(study("network", *sizes, worse)))
    assert "Smallest: method, size 1 (1 mm, 1 bytes)" in text
    assert "a tenth of the error costs 10 times the size" in text
    assert "3 times smaller and no less accurate" in text
    assert "uick" not in text
    assert "time." not in text


def test_point_without_time_and_bytes_is_told_in_its_count() -> None:
    sizes = [Point("network", f"width {size}", 1 / size, counts={"decoder parameters": 1000 * size}, cost="decoder parameters") for size in (1, 10)]
    text = " ".join(findings_of(study("network", *sizes)))
    assert "Smallest: network, width 1 (1 mm, 1,000 decoder parameters)" in text
    assert "a tenth of the error costs 10 times the size" in text


def test_error_of_zero_can_stand_on_a_logarithmic_axis() -> None:
    assert point(0.0, 1.0).pair == (EXACT_MM, 1.0)


def test_interleaved_timing_takes_turns_and_leaves_out_the_warm_up() -> None:
    called: list[str] = []
    timings = interleaved({"a": lambda: called.append("a"), "b": lambda: called.append("b")}, repeats=3, warm_up=1)
    assert called == ["a", "b"] * 4
    assert timings["a"].repeats == 3


def test_a_short_task_is_called_until_its_time_has_passed_and_counts_with_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    now, called = [0.0], {"short": 0, "long": 0}

    def task(name: str, seconds: float) -> None:
        called[name] += 1
        now[0] += seconds

    monkeypatch.setattr(studies, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    timings = interleaved({"short": lambda: task("short", 0.25), "long": lambda: task("long", 4.0)}, repeats=2, least_seconds=1.0)
    assert called == {"short": 3 * 4, "long": 3}
    assert (timings["short"].median, timings["long"].median) == (0.25, 4.0)


def test_timing_is_the_median_with_its_spread_and_can_be_shared_out() -> None:
    timing = Timing.of([3.0, 1.0, 2.0]).divided_by(2)
    assert (timing.median, timing.p5, timing.p95) == pytest.approx((1.0, 0.55, 1.45))
    assert timing.divided_by(0.25).median == 4.0


def test_durations_are_told_in_the_unit_that_suits_them() -> None:
    assert [duration_text(seconds) for seconds in (90.0, 0.0123, 4.5e-6, 2e-9)] == ["90 s", "12.3 ms", "4.5 us", "2 ns"]


def test_large_factors_are_written_out() -> None:
    assert "Along the front a tenth of the error costs the same time." in findings_of(study("training", point(1.0, 1.0), point(0.01, 1.02)))
    assert "Along the front a tenth of the error costs 34,000 times the time." in findings_of(study("training", point(1.0, 1e-3), point(0.1, 34.2)))
    assert "Along the front a tenth of the error costs 34,000,000 times the time." in findings_of(study("training", point(1.0, 1e-6), point(0.1, 34.2)))
