"""KNN-1 is exact: the same as a search among each frame's own samples."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.baselines import NearestSample, nearest_sample_bytes


def scattered(count: int, seed: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((count, 3)).astype(np.float32))


def chosen(count: int, kept: int, seed: int) -> Tensor:
    return torch.from_numpy(np.sort(np.random.default_rng(seed).permutation(count)[:kept]).astype(np.int32))


@pytest.mark.parametrize("neighbours", [1, 4, 24])
@pytest.mark.parametrize("kept", [1, 60, 800, 2000])
def test_value_is_that_of_the_nearest_kept_sample(neighbours: int, kept: int) -> None:
    points, queries = scattered(2000, 0), scattered(300, 1)
    nearest_sample = NearestSample(points, queries, neighbours)
    for frame in range(3):
        distances, selection = scattered(2000, 10 + frame)[:, 0], chosen(2000, kept, frame)
        _, nearest = cKDTree(points[selection].numpy()).query(queries.numpy())
        assert torch.equal(nearest_sample.values(distances, selection), distances[selection][nearest])


def test_fewer_points_than_neighbours_are_enough() -> None:
    points = scattered(3, 0)
    distances, selection = torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0, 1, 2], dtype=torch.int32)
    assert torch.equal(NearestSample(points, points, neighbours=24).values(distances, selection), distances)


def test_what_cannot_be_answered_is_refused() -> None:
    points, none = scattered(10, 0), torch.zeros(0, dtype=torch.int32)
    nearest_sample = NearestSample(points, points)
    with pytest.raises(ConfigurationError, match="at least one kept point, found 0 kept"):
        nearest_sample.values(points[:, 0], none)
    with pytest.raises(ConfigurationError, match="needs finite distances"):
        nearest_sample.values(torch.full((10,), torch.nan), torch.arange(10, dtype=torch.int32))
    with pytest.raises(ConfigurationError, match="found 10 points, neighbours=0"):
        NearestSample(points, points, neighbours=0)
    with pytest.raises(ConfigurationError, match="found 0 points"):
        NearestSample(points[:0], points)


def test_size_is_that_of_the_smaller_layout() -> None:
    apart = np.arange(12, dtype=np.int32).reshape(2, 6)
    assert nearest_sample_bytes(apart) == 12 * 16, "position and distance of each: nothing is shared"
    shared = np.array([[0, 1, 2, 4, 7, 9, 10], [0, 1, 3, 4, 7, 9, 11]], dtype=np.int32)
    assert nearest_sample_bytes(shared) == 9 * 12 + 2 * 2 + 14 * 4, "nine points once, nine bits in two bytes a frame, and the distances"
