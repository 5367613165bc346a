"""Learned features on grids, against the formula written out corner by corner."""

from itertools import product

import pytest
import torch

from sdfnet.models.grid_features import LARGEST_FIRST_FEATURE, GridFeatures
from sdfnet.models.settings import ModelSettings

EXTENT = torch.tensor([1.2, 0.8, 1.0])
LEVELS = [2, 4, 7]  # 27, 125 and 512 grid points
TABLE = 100  # so the first level has a row a point and the others are hashed


def grid() -> GridFeatures:
    made = GridFeatures(LEVELS, 2, TABLE, EXTENT)
    torch.nn.init.normal_(made.table)
    return made


def slow_features(grid: GridFeatures, point: torch.Tensor) -> torch.Tensor:
    """Section 3 and equation 4 of Mueller et al. for one point, one corner after the other, in float64."""
    rows, primes = [27, TABLE, TABLE], (1, 2_654_435_761, 805_459_861)
    table, found, start = grid.table.detach().double().view(-1, 2), [], 0
    for resolution, count in zip(LEVELS, rows, strict=True):
        place = ((point.double() / EXTENT.double() + 1) / 2).clamp(0, 1) * resolution
        cell = [min(int(x), resolution - 1) for x in place]
        features = torch.zeros(2, dtype=torch.float64)
        for corner in product((0, 1), repeat=3):
            weight, index = 1.0, [first + step for first, step in zip(cell, corner, strict=True)]
            for axis in range(3):
                weight *= 1 - abs(float(place[axis]) - index[axis])
            hashed = (index[0] * primes[0]) ^ (index[1] * primes[1]) ^ (index[2] * primes[2])
            side = resolution + 1
            row = (index[0] * side + index[1]) * side + index[2] if side**3 <= count else hashed % count
            features += weight * table[start + row]
        found.append(features)
        start += count
    return torch.cat(found)


def test_features_are_those_of_the_formula_inside_and_outside_the_box() -> None:
    encoding, points = grid(), 1.5 * (2 * torch.rand(200, 3) - 1)
    expected = torch.stack([slow_features(encoding, point) for point in points])
    # a place in seven cells is rounded by 4e-7 of one, and features of deviation one differ by a few across it
    torch.testing.assert_close(encoding(points).double(), expected, rtol=0, atol=1e-5)


def test_a_grid_point_has_its_own_row_and_nothing_of_others() -> None:
    encoding = GridFeatures([2], 3, 27, EXTENT)
    corners = torch.cartesian_prod(*[torch.arange(3)] * 3)
    assert torch.equal(encoding((corners - 1) * EXTENT), encoding.table.view(27, 3))


def test_a_point_outside_has_the_features_of_the_nearest_point_of_the_box() -> None:
    encoding, outside = grid(), torch.tensor([[5.0, 0.1, -3.0], [-1.3, -0.9, 0.3]])
    assert torch.equal(encoding(outside), encoding(outside.clamp(-EXTENT, EXTENT)))


def test_the_gradient_by_the_point_is_that_of_finite_differences_and_has_one_itself() -> None:
    encoding, points = grid().double(), (0.7 * (2 * torch.rand(50, 3) - 1)).double().requires_grad_()
    (slope,) = torch.autograd.grad(encoding(points).square().sum(), points, create_graph=True)
    step = torch.tensor([1e-6, 0.0, 0.0], dtype=torch.float64)
    with torch.no_grad():
        difference = (encoding(points + step).square().sum(1) - encoding(points - step).square().sum(1)) / 2e-6
    # the features are smooth within a cell; only a point within 1e-6 of a cell's side would differ
    torch.testing.assert_close(slope[:, 0].detach(), difference, rtol=1e-6, atol=1e-6)
    slope.square().sum().backward()
    assert encoding.table.grad is not None
    assert float(encoding.table.grad.abs().max()) > 0


def test_features_begin_small_and_one_number_a_row_and_feature() -> None:
    table = GridFeatures(LEVELS, 2, TABLE, EXTENT).table.detach()
    assert table.shape == (2 * (27 + TABLE + TABLE),)
    assert 0.9 * LARGEST_FIRST_FEATURE < float(table.abs().max()) <= LARGEST_FIRST_FEATURE


@pytest.mark.parametrize(("kind", "resolutions"), [("hash_grid", [8, 12, 18, 27]), ("dense_grid", [8])])
def test_levels_grow_by_the_factor_of_the_settings_and_a_dense_grid_has_one(kind: str, resolutions: list[int]) -> None:
    assert ModelSettings(encoding=kind).grid_resolutions == resolutions


def test_a_point_that_is_not_finite_shows_in_its_features() -> None:
    assert grid()(torch.tensor([[float("nan"), 0.0, 0.0]])).isnan().all()


def test_autocast_moves_no_point() -> None:
    encoding, points = grid(), torch.rand(30, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under_autocast = encoding(points)
    assert torch.equal(under_autocast, encoding(points))
