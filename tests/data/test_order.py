"""The order in which shapes are seen."""

import numpy as np
import pytest

from sdfnet.data.order import frames_of_step, pass_order

PAPER = {"per_step": 2, "stride": 1, "ordered_epochs": 6, "seed": 0}


def test_the_first_six_epochs_go_up_and_down_in_turn() -> None:
    for epoch in range(6):
        order = pass_order(7, epoch, 0, ordered_epochs=6, seed=3)
        np.testing.assert_array_equal(order, np.arange(7) if epoch % 2 == 0 else np.arange(7)[::-1])


def test_passes_of_one_ordered_epoch_alternate_too() -> None:
    assert [pass_order(3, 1, k, 6, 0).tolist() for k in range(3)] == [[2, 1, 0], [0, 1, 2], [2, 1, 0]]


@pytest.mark.parametrize("seed", [0, 1])
def test_from_the_seventh_epoch_on_every_pass_is_another_permutation_that_can_be_repeated(seed: int) -> None:
    passes = [(epoch, index) for epoch in (6, 7, 50) for index in (0, 1)]
    orders = [pass_order(50, epoch, index, 6, seed) for epoch, index in passes]
    for (epoch, index), order in zip(passes, orders, strict=True):
        np.testing.assert_array_equal(np.sort(order), np.arange(50))
        np.testing.assert_array_equal(pass_order(50, epoch, index, 6, seed), order)
    assert len({tuple(order) for order in orders}) == len(passes)


def test_another_seed_gives_another_order() -> None:
    assert pass_order(50, 6, 0, 6, 0).tolist() != pass_order(50, 6, 0, 6, 1).tolist()


def test_the_papers_pairs_are_each_shape_with_the_one_that_follows_and_the_last_with_the_first() -> None:
    pairs = [frames_of_step(4, 0, step, **PAPER).tolist() for step in range(4)]
    assert pairs == [[0, 1], [1, 2], [2, 3], [3, 0]]
    assert frames_of_step(4, 1, 0, **PAPER).tolist() == [3, 2]


@pytest.mark.parametrize(("per_step", "stride"), [(2, 1), (16, 16), (16, 8), (5, 5)])
@pytest.mark.parametrize("epoch", [0, 9])
def test_a_pass_shows_every_shape(per_step: int, stride: int, epoch: int) -> None:
    frames = 101
    steps = -(-frames // stride)
    seen = np.concatenate([frames_of_step(frames, epoch, step, per_step, stride, 6, 0) for step in range(steps)])
    np.testing.assert_array_equal(np.unique(seen), np.arange(frames))
    assert len(seen) == steps * per_step
    counts = np.bincount(seen)
    assert counts.max() - counts.min() <= -(-per_step // stride)  # only the wrap at the end sees shapes once more


def test_the_step_after_a_pass_begins_the_next_pass() -> None:
    second = frames_of_step(6, 8, 6, per_step=2, stride=1, ordered_epochs=6, seed=0)
    np.testing.assert_array_equal(second, pass_order(6, 8, 1, 6, 0)[:2])
