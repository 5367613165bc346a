"""A network asked only where its surface may be: the same triangles and bits as from the whole grid, for each shape in turn."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from sdfnet.evaluation.reconstruct import Grid, surface_from_values, values_of_frames
from sdfnet.evaluation.sparse_network import SparseReconstruction
from sdfnet.models.decoder import SdfCalculator
from sdfnet.models.settings import ModelSettings
from sdfnet.models.storage import as_stored

RESOLUTION = 33
STEPS = 150
RADII = torch.tensor([0.4, 0.5, 0.6])


@pytest.fixture(scope="module")
def grid() -> Grid:
    """A box about every ball."""
    return Grid(np.full(3, -1.0), np.array([1.0, 1.1, 1.0]), RESOLUTION)


KINDS: dict[str, dict[str, Any]] = {
    "relu": {"activation": "relu"},
    "gelu": {"activation": "gelu"},
    "silu": {"activation": "silu"},
    "siren": {"activation": "siren", "encoding": "none", "omega": 4.0},
    "hash grid": {"encoding": "hash_grid", "grid_levels": 2, "grid_resolution": 4, "grid_table_size": 256},
    "modulated": {"conditioning": "modulated"},
    "int8": {},
}


@pytest.fixture(scope="module", params=KINDS)
def decoder(request: pytest.FixtureRequest, grid: Grid) -> SdfCalculator:
    """Taught for a second to tell the distance to balls by their radius."""
    torch.manual_seed(0)
    usual = ModelSettings(width=24, depth=2, latent=1, encoding="fourier", frequencies=16, frequency_scale=0.5)
    settings = replace(usual, **KINDS[request.param])
    lower, upper = torch.from_numpy(grid.lower).float(), torch.from_numpy(grid.upper).float()
    taught = SdfCalculator(settings, lower, upper)
    optimiser = torch.optim.Adam(taught.parameters(), 1e-2)
    for _ in range(STEPS):
        points = lower + (upper - lower) * torch.rand(512, 3)
        optimiser.zero_grad()
        (taught(RADII[:, None], points) - (points.norm(dim=1) - RADII[:, None])).abs().mean().backward()
        optimiser.step()
    taught.requires_grad_(False)
    if request.param == "int8":
        for weights in taught.parameters():
            weights.copy_(as_stored(weights.reshape(len(weights), -1), "int8").reshape(weights.shape))
    return taught


@pytest.fixture(scope="module")
def whole(decoder: SdfCalculator, grid: Grid) -> np.ndarray:
    """Of the ball of radius 0.5, at every grid point."""
    found: np.ndarray = values_of_frames(partial(decoder, torch.tensor([[0.5]])), grid)[0].numpy().reshape(-1)
    return found


def test_every_shape_has_the_triangles_of_the_whole_grid(decoder: SdfCalculator, grid: Grid) -> None:
    reconstruction = SparseReconstruction.measured(decoder, grid, RADII[[0, 2], None])
    for radius in (0.4, 0.45, 0.55, 0.6, 0.4):
        latent = torch.tensor([radius])
        expected = surface_from_values(values_of_frames(partial(decoder, latent[None]), grid)[0], grid)
        surface = reconstruction.surface(latent)
        np.testing.assert_array_equal(surface.faces, expected.faces)
        np.testing.assert_array_equal(surface.vertices, expected.vertices)


@pytest.mark.parametrize("count", [1, 63, 64, 65, 4096, 4097, 9000])
def test_values_have_the_bits_of_the_whole_grid_however_many_are_asked(decoder: SdfCalculator, grid: Grid, whole: np.ndarray, count: int) -> None:
    indices = np.random.default_rng(count).permutation(RESOLUTION**3)[:count]
    found = SparseReconstruction(decoder, grid, (1.0, 1.0, 1.0)).values_at(torch.tensor([0.5]), indices)
    np.testing.assert_array_equal(found, whole[indices])


def test_a_point_is_encoded_once_for_all_shapes(decoder: SdfCalculator, grid: Grid, monkeypatch: pytest.MonkeyPatch) -> None:
    encoded, rows = decoder.encoded, []

    def counted(points: torch.Tensor) -> torch.Tensor:
        rows.append(len(points))
        return encoded(points)

    monkeypatch.setattr(decoder, "encoded", counted)
    reconstruction = SparseReconstruction(decoder, grid, (1.5, 1.5, 1.5))
    first = reconstruction.values(torch.tensor([0.5])).values
    asked = sum(rows)
    assert len(first) > 0
    other = reconstruction.values(torch.tensor([0.47]))
    assert asked < sum(rows) < asked + other.asked  # what the first shape asked at was not encoded again
    np.testing.assert_array_equal(other.values, SparseReconstruction(decoder, grid, (1.5, 1.5, 1.5)).values(torch.tensor([0.47])).values)


def test_no_point_asked_is_no_value(decoder: SdfCalculator, grid: Grid) -> None:
    assert SparseReconstruction(decoder, grid, (1.0, 1.0, 1.0)).values_at(torch.tensor([0.5]), np.empty(0, np.int64)).shape == (0,)


def test_the_decoder_that_was_given_is_left_as_it_was(decoder: SdfCalculator, grid: Grid) -> None:
    SparseReconstruction(decoder, grid, (1.0, 1.0, 1.0))
    assert not any(getattr(module, "inplace", False) for module in decoder.modules())


def test_refined_vertices_lie_where_the_network_is_zero(decoder: SdfCalculator, grid: Grid) -> None:
    reconstruction, latent = SparseReconstruction(decoder, grid, (1.5, 1.5, 1.5)), torch.tensor([0.5])

    def height(refine_steps: int) -> float:
        return float(
            decoder(latent[None], torch.from_numpy(reconstruction.refined(reconstruction.surface(latent), latent, refine_steps).vertices).float()).abs().mean()
        )

    # A network of creases, such as relu's, is linear between them: most vertices arrive in one step, those beyond a crease in two.
    assert height(2) < 0.1 * height(0)
