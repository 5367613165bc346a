"""How a load changes with time."""

import numpy as np
import pytest
from scipy.integrate import trapezoid

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.history import CONSTANT, History, pulse, ramp


def test_without_numbers_a_load_is_constant_and_full() -> None:
    assert CONSTANT.is_constant
    assert [CONSTANT.factor(time) for time in (-1.0, 0.0, 7.0)] == [1.0, 1.0, 1.0]


def test_one_value_at_all_times_is_constant() -> None:
    assert History((0.0, 1.0), (2.0, 2.0)).is_constant
    assert not History((0.0, 1.0), (2.0, 2.5)).is_constant


def test_a_table_is_joined_by_straight_lines_and_goes_on_at_both_ends() -> None:
    table = History((1.0, 2.0, 4.0), (0.0, 3.0, -1.0))
    assert not table.is_constant
    assert [table.factor(time) for time in (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 9.0)] == [0.0, 0.0, 1.5, 3.0, 1.0, -1.0, -1.0]


def test_a_ramp_rises_to_full_strength_and_stays() -> None:
    assert [ramp(0.5).factor(time) for time in (0.0, 0.25, 0.5, 3.0)] == [0.0, 0.5, 1.0, 1.0]


def test_a_pulse_is_half_a_sine_to_3e_4_and_nothing_outside() -> None:
    times, half_sine = np.linspace(0.2, 0.6, 1001), pulse(0.2, 0.6)
    found = np.array([half_sine.factor(time) for time in times])
    error = np.abs(found - np.sin(np.pi * (times - 0.2) / 0.4)).max()
    assert 1e-4 < error < 3.1e-4  # (pi/64)^2 / 8 is 3.01e-4
    assert (half_sine.factor(0.19), half_sine.factor(0.6), half_sine.factor(0.7)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("times", "values", "message"),
    [
        ((0.0, 1.0), (1.0,), "must be equally many and not empty, found 2 and 1"),
        ((), (), "must be equally many and not empty, found 0 and 0"),
        ((0.0, 0.0), (1.0, 2.0), "history.times must rise and all numbers be finite"),
        ((0.0, 1.0), (1.0, float("nan")), "history.times must rise and all numbers be finite"),
    ],
)
def test_a_table_that_is_none_is_refused(times: tuple[float, ...], values: tuple[float, ...], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        History(times, values)


def test_a_ramp_and_a_pulse_that_take_no_time_are_refused() -> None:
    for made in (lambda: ramp(0.0), lambda: pulse(1.0, 1.0), lambda: pulse(1.0, 0.5)):
        with pytest.raises(ConfigurationError, match="history.times must rise"):
            made()


def test_steps_that_meet_every_bend_miss_nothing_and_steps_over_a_pulse_all_of_it() -> None:
    triangle = History((0.3, 0.5, 0.7), (0.0, 2.0, 0.0))
    assert triangle.largest_miss(0.1, 1.0) == pytest.approx(0.0, abs=1e-15)
    assert triangle.largest_miss(1.0, 1.0) == 1.0
    assert History((3.0, 5.0, 7.0), (0.0, 2.0, 0.0)).largest_miss(1.0, 1.0) == 0.0  # there is nothing before the end
    assert CONSTANT.largest_miss(0.7, 1.0) == 0.0


def test_a_sharp_feature_is_missed_as_much_in_a_long_run_as_in_a_short_one() -> None:
    blow = History((0.31, 0.32, 0.33), (0.0, 1.0, 0.0))
    assert blow.largest_miss(0.1, 1.0) == blow.largest_miss(0.1, 1000.0) == 1.0
    assert ramp(1e-3).largest_miss(0.5, 1.0) == pytest.approx(1 - 1e-3 / 0.5, rel=1e-12)
    assert ramp(1e-3).largest_miss(0.5, 1000.0) == pytest.approx(1 - 1e-3 / 0.5, rel=1e-12)


def test_one_bend_is_missed_by_a_quarter_of_a_step_of_its_slope_at_most() -> None:
    assert History((0.5, 1.5), (0.0, 1.0)).largest_miss(1.0, 1.0) == pytest.approx(0.5, rel=1e-12)  # over what it reaches until then, a half
    assert History((0.25, 0.5, 2.25), (0.0, 0.125, 1.0)).largest_miss(0.5, 2.25) == pytest.approx(0.25 * 0.5 * 0.5, rel=1e-12)


@pytest.mark.parametrize("history", [pulse(0.2, 0.6), History((0.0, 0.31, 0.33, 0.9), (0.0, 1.0, -2.0, 0.5)), ramp(1e-6)])
@pytest.mark.parametrize("time_step", [0.01, 0.07, 0.25])
def test_what_steps_miss_is_how_far_lines_between_the_values_at_the_steps_come_from_the_load(history: History, time_step: float) -> None:
    times = np.linspace(0.0, 1.0, 20_001)
    steps = np.append(np.arange(0.0, 1.0, time_step), 1.0)
    factors, at_steps = (np.interp(several, history.times, history.values) for several in (times, steps))
    expected = np.abs(factors - np.interp(times, steps, at_steps)).max() / np.abs(factors).max()
    assert history.largest_miss(time_step, 1.0) == pytest.approx(expected, rel=0.01)  # a bend may fall between two of the times


@pytest.mark.parametrize("history", [pulse(0.2, 0.6), History((0.1, 0.31, 0.33, 0.9), (0.5, 1.0, -2.0, 0.5)), ramp(1e-6), CONSTANT])
def test_the_means_of_steps_hold_the_whole_impulse_whatever_the_step(history: History) -> None:
    fine = np.union1d(np.linspace(0.0, 1.0, 1001), [time for time in history.times if time < 1])
    impulse = trapezoid(np.interp(fine, history.times, history.values), fine)
    for steps in (1, 7, 40):
        ends = np.linspace(0.0, 1.0, steps + 1)
        means = [history.mean(begin, end) for begin, end in zip(ends[:-1], ends[1:], strict=True)]
        assert np.dot(means, np.diff(ends)) == pytest.approx(impulse, rel=1e-13)
        np.testing.assert_allclose(history.means(ends), means, rtol=0, atol=1e-15)


def test_where_the_factor_does_not_change_its_mean_is_the_factor_bit_for_bit() -> None:
    assert History((0.2, 0.3), (0.1, 0.7)).mean(0.3, 1 / 3 + 0.3) == 0.7
    assert History((0.2, 0.3), (0.1, 0.7)).mean(0.0, 0.1) == 0.1


def test_the_bends_between_two_times_leave_out_those_at_the_ends() -> None:
    assert History((0.0, 0.5, 1.0, 2.0), (0.0, 1.0, 0.0, 3.0)).bends(0.0, 2.0).tolist() == [0.5, 1.0]
    assert History((0.0, 0.5), (0.0, 1.0)).bends(0.6, 2.0).tolist() == []
