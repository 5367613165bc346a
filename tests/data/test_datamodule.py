"""What a training step sees: a pure function of seed, epoch and step; held-out points stay out; distances belong to their points and frames."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sdfnet.data import datamodule
from sdfnet.data.datamodule import Batch, ShapeFamily, split_frames
from sdfnet.data.order import frames_of_step, pass_order
from sdfnet.data.settings import BatchSettings
from sdfnet.errors import ConfigurationError
from sdfnet.geometry.distance import signed_distance
from sdfnet.geometry.solids import Sphere
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.scene import Dataset, Effect, Recording, Sampling, Scene

FRAMES = 7
EFFECTS: dict[str, Effect] = {side: PressurePoke(center=(x, 0.0, 0.0), radius=0.03, pressure=3000.0) for side, x in (("left", -0.05), ("right", 0.05))}
BALL = Dataset(Scene(Sphere(cells=4), EFFECTS, recording=Recording(duration=0.002, frames=FRAMES)), Sampling(count=3000, near_surface_count=1500))
PAPER = BatchSettings(validation_points=200)
SHARED = BatchSettings(frames_per_step=3, stride=3, points_per_step=200, near_share=0.5, steps_per_epoch=5, ordered_epochs=0, validation_points=200)
BOTH = pytest.mark.parametrize("settings", [PAPER, SHARED], ids=["paper", "shared"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


def family_of(folder: Path, settings: BatchSettings, split: str = "all", seed: int = 0) -> ShapeFamily:
    family = ShapeFamily(BALL, folder, settings, split, seed)
    family.prepare_data()
    family.setup("fit")
    return family


def same(first: Batch, second: Batch) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in ("frames", "shapes", "points", "distances"))


def rows(points: Tensor) -> set[bytes]:
    return {row.tobytes() for row in points.reshape(-1, 3).numpy()}


@BOTH
def test_a_step_is_the_same_whatever_was_asked_before_it(folder: Path, settings: BatchSettings) -> None:
    straight = {(epoch, step): family_of(folder, settings).step(epoch, step) for epoch in (0, 8) for step in (0, 4)}
    wandering = family_of(folder, settings)
    for epoch, step in reversed(list(straight)):
        wandering.step(epoch + 1, step)
        torch.rand(1)
        assert same(wandering.step(epoch, step), straight[epoch, step])


@BOTH
def test_steps_epochs_and_seeds_differ(folder: Path, settings: BatchSettings) -> None:
    family = family_of(folder, settings)
    assert not same(family.step(9, 0), family.step(9, 1))
    assert not same(family.step(9, 0), family.step(10, 0))
    assert not same(family.step(9, 0), family_of(folder, settings, seed=1).step(9, 0))


@BOTH
def test_distances_belong_to_their_points_and_frames(folder: Path, settings: BatchSettings) -> None:
    family = family_of(folder, settings)
    for batch in (family.step(0, 1), family.step(9, 2), family.validation):
        for place, frame in enumerate(batch.frames.tolist()):
            surface = family.trajectory.surface(frame)
            points = batch.points if batch.points.ndim == 2 else batch.points[place]
            # stored distances are searched within a bound from the last frame; both round to float32 on a ball of 50 mm
            torch.testing.assert_close(batch.distances[place], signed_distance(points.contiguous(), surface), rtol=0, atol=1e-7)
            np.testing.assert_array_equal(batch.shapes[place].numpy(), surface.vertices.astype(np.float32))


def test_frames_are_told_apart(folder: Path) -> None:
    distances = family_of(folder, SHARED).validation.distances
    assert float((distances[0] - distances[-1]).abs().max()) > 1e-4  # a thousand times the tolerance above


def test_normals_come_where_they_are_asked_for_and_belong_to_their_vertices(folder: Path) -> None:
    family = family_of(folder, SHARED)
    batch = family.step(1, 2, 40)
    assert family.step(1, 2).facing is None
    assert batch.facing is not None
    vertices, normals = batch.facing.vertices, batch.facing.normals
    assert vertices.shape == normals.shape == (len(batch.frames), 40, 3)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(normals.shape[:2]))
    for frame, some, outward in zip(batch.frames.tolist(), vertices, normals, strict=True):
        outside = some + 1e-3 * outward
        assert (signed_distance(outside, family.trajectory.surface(frame)) > 5e-4).all()
    again, other = family.step(1, 2, 40).facing, family.step(1, 3, 40).facing
    assert again is not None
    assert other is not None
    assert torch.equal(again.vertices, vertices)
    assert not torch.equal(other.vertices, vertices)


@BOTH
def test_held_out_points_are_never_trained_on(folder: Path, settings: BatchSettings) -> None:
    family = family_of(folder, settings)
    trained = set().union(*(rows(family.step(epoch, step).points) for epoch in range(12) for step in range(family.steps_per_epoch)))
    held_out = rows(family.validation.points)
    assert len(held_out) == 200
    assert trained.isdisjoint(held_out)
    assert len(trained) > 2000


def test_validation_points_come_from_both_sets_in_the_share_of_training(folder: Path) -> None:
    family = family_of(folder, SHARED)
    held_out = rows(family.validation.points)
    assert len(held_out & rows(torch.from_numpy(family.samples.near_points))) == 100
    assert len(held_out & rows(torch.from_numpy(family.samples.points))) == 100


def test_a_drawn_step_has_its_share_of_points_about_the_surface(folder: Path) -> None:
    family = family_of(folder, SHARED)
    batch = family.step(0, 0)
    assert batch.points.shape == (200, 3)
    assert batch.distances.shape == (3, 200)
    near = rows(torch.from_numpy(family.samples.near_points))
    assert [point.numpy().tobytes() in near for point in batch.points] == [True] * 100 + [False] * 100


def test_a_paper_step_is_a_pair_each_with_the_points_that_it_kept(folder: Path) -> None:
    family = family_of(folder, PAPER)
    held_out = rows(family.validation.points)
    counts = []
    for step in range(family.steps_per_epoch):
        batch = family.step(0, step)
        assert batch.frames.tolist() == [step, (step + 1) % FRAMES]
        for place, frame in enumerate(batch.frames.tolist()):
            kept = rows(torch.from_numpy(family.samples.points[family.samples.kept[frame]]))
            given = rows(batch.points[place])
            assert given <= kept - held_out
            counts.append((len(given), len(kept - held_out)))
    # every frame gives as many points as the one that has fewest once the held-out ones are gone
    assert {given for given, _ in counts} == {min(available for _, available in counts)}


def test_points_beyond_the_smallest_frames_count_are_left_out_at_random(folder: Path) -> None:
    family = family_of(folder, PAPER)
    held_out = rows(family.validation.points)
    last_kept = []
    for frame in range(FRAMES):
        kept = [row for row in family.samples.points[family.samples.kept[frame]] if row.tobytes() not in held_out]
        place = family.step(0, frame).points[0]
        if len(kept) > len(place):
            last_kept.append(kept[-1].tobytes() in rows(place))
    # rows are in Morton order: cutting them at the end would lose the last point of every such frame, a corner of the box
    assert len(last_kept) >= 4
    assert any(last_kept)


@pytest.mark.parametrize(
    ("split", "frames", "train"),
    [
        ("all", 11, list(range(11))),
        ("interpolation", 11, [0, 1, 3, 4, 5, 6, 8, 9, 10]),
        ("extrapolation", 11, list(range(9))),
        ("extrapolation", 101, list(range(81))),
    ],
)
def test_splits_are_by_frame(split: str, frames: int, train: list[int]) -> None:
    assert split_frames(frames, split).tolist() == train


@BOTH
@pytest.mark.parametrize("split", ["interpolation", "extrapolation"])
def test_frames_of_the_other_part_are_never_seen(folder: Path, settings: BatchSettings, split: str) -> None:
    family = family_of(folder, settings, split)
    seen = {frame for epoch in range(9) for step in range(family.steps_per_epoch) for frame in family.step(epoch, step).frames.tolist()}
    assert seen == set(split_frames(FRAMES, split).tolist()) != set(range(FRAMES))
    assert set(family.validation.frames.tolist()) == seen
    assert len(family.shapes) == FRAMES


def test_frames_go_up_then_down_for_six_epochs_and_are_shuffled_from_the_seventh() -> None:
    orders = [pass_order(101, epoch, 0, ordered_epochs=6, seed=0).tolist() for epoch in range(9)]
    up = list(range(101))
    assert orders[:6] == [up, up[::-1]] * 3
    for order in orders[6:]:
        assert sorted(order) == up
        assert sum(abs(b - a) == 1 for a, b in zip(order, order[1:], strict=False)) < 10  # two neighbours of a shuffled order meet with a chance of 2 %
    assert len({tuple(order) for order in orders[6:]}) == 3


def test_pairs_are_each_frame_with_the_next_in_order() -> None:
    for epoch in (0, 1, 7):
        order = pass_order(5, epoch, 0, 6, 3).tolist()
        pairs = [frames_of_step(5, epoch, step, 2, 1, 6, 3).tolist() for step in range(5)]
        assert pairs == [[order[k], order[(k + 1) % 5]] for k in range(5)]


def test_a_stride_takes_every_frame_once_a_pass_and_another_order_in_the_next() -> None:
    steps = [frames_of_step(9, 0, step, 3, 3, 0, 0).tolist() for step in range(6)]
    first, second = ([frame for step in half for frame in step] for half in (steps[:3], steps[3:]))
    assert sorted(first) == sorted(second) == list(range(9))
    assert first != second


def test_files_are_prepared_once_and_read_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def counted(name: str) -> Any:
        original = getattr(datamodule, name)

        def call(*arguments: Any) -> Any:
            calls.append(name)
            return original(*arguments)

        return call

    for name in ("prepare", "read_trajectory", "read_distances"):
        monkeypatch.setattr(datamodule, name, counted(name))
    family = family_of(folder, SHARED)
    family.setup("validate")
    assert sorted(calls) == ["prepare", "read_distances", "read_trajectory"]


def test_a_second_family_finds_the_files_of_the_first(folder: Path) -> None:
    family_of(folder, SHARED)
    assert family_of(folder, PAPER).files.built == ()


def test_a_process_that_did_not_prepare_finds_the_files_too(folder: Path) -> None:
    family = ShapeFamily(BALL, folder, SHARED)
    family.setup("fit")
    assert same(family.step(3, 1), family_of(folder, SHARED).step(3, 1))


def test_an_epoch_is_one_pass_or_as_many_steps_as_told(folder: Path) -> None:
    assert family_of(folder, PAPER).steps_per_epoch == FRAMES
    assert ShapeFamily(BALL, folder, BatchSettings(frames_per_step=3, stride=3)).steps_per_epoch == 3
    family = family_of(folder, SHARED)
    assert family.steps_per_epoch == 5
    assert list(family.train_dataloader()) == [0, 1, 2, 3, 4]
    assert list(family.val_dataloader()) == [0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"frames_per_step": 0}, "frames_per_step and stride must be at least 1, found 0 and 1"),
        ({"points_per_step": 0}, "batch.points_per_step must be at least 1, found 0"),
        ({"steps_per_epoch": 0}, "batch.steps_per_epoch must be at least 1, found 0"),
        ({"validation_points": 0}, "batch.validation_points must be at least 1, found 0"),
        ({"near_share": 1.5}, r"batch.near_share must lie in \[0, 1\], found 1.5"),
        ({"near_share": 0.5}, "batch.near_share needs batch.points_per_step"),
    ],
)
def test_batches_that_cannot_be_are_refused_by_name(wrong: dict[str, int | float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        BatchSettings(**wrong)  # type: ignore[arg-type]


def test_a_step_of_more_frames_than_there_are_sees_each_once(folder: Path) -> None:
    family = ShapeFamily(BALL, folder, BatchSettings(frames_per_step=16, stride=16, points_per_step=32))
    family.prepare_data()
    family.setup()
    assert [sorted(family.step(0, step).frames.tolist()) for step in range(3)] == 3 * [list(range(7))]


def test_batches_that_the_dataset_cannot_give_are_refused(folder: Path) -> None:
    bare = replace(BALL, sampling=replace(BALL.sampling, near_surface_count=0))
    with pytest.raises(ConfigurationError, match="near_surface_count gives none to train on"):
        ShapeFamily(bare, folder, BatchSettings(points_per_step=10, near_share=0.5))
    with pytest.raises(ConfigurationError, match="split must be one of all, interpolation, extrapolation; found 'random'"):
        split_frames(10, "random")
