"""Deforming shapes kept as distance fields: exact where they must be, and as large as they say."""

from unittest import mock

import numpy as np
import pytest
import torch

from sdfnet.cost.field_baselines import GridField, NearestSampleField, NetworkField, distances_where_it_may_be, network_where_it_may_be
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.store import DistanceSamples
from sdfnet.errors import ConfigurationError, ReconstructionError
from sdfnet.evaluation.baselines import NearestSample
from sdfnet.evaluation.reconstruct import Grid, surface_from_values
from sdfnet.evaluation.sparse_network import SparseReconstruction
from sdfnet.geometry.distance import signed_distance
from sdfnet.models.decoder import CHUNK
from sdfnet.models.networks import Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.trajectory import Trajectory
from tests.cost.conftest import ball_networks


def test_grid_of_distances_of_a_plane_is_exact_between_its_points_and_held_outside() -> None:
    grid = Grid(np.array([-1.0, 0.0, 2.0]), np.array([1.0, 3.0, 2.5]), 4)
    normal = torch.tensor([0.6, -0.64, 0.48])
    values = (grid.points() @ normal - 0.3).reshape(1, 4, 4, 4).numpy()
    field = GridField(values, grid.lower, grid.upper)
    lower, upper = torch.tensor([-1.0, 0.0, 2.0]), torch.tensor([1.0, 3.0, 2.5])
    points = lower + torch.rand(500, 3) * (upper - lower)
    torch.testing.assert_close(field.distances(0, points), points @ normal - 0.3, rtol=0, atol=2e-6)  # float32 at a size of three
    outside = points + torch.tensor([5.0, 0.0, 0.0])
    held = torch.minimum(outside, upper)
    torch.testing.assert_close(field.distances(0, outside), held @ normal - 0.3, rtol=0, atol=2e-6)


def test_grid_holds_the_exact_distances_of_each_frame_and_nothing_else(trajectory: Trajectory, samples: DistanceSamples) -> None:
    grid = Grid(samples.box.lower, samples.box.upper, 7)
    field = GridField.of(trajectory, grid)
    for frame in (0, 3):
        exact = signed_distance(grid.points(), trajectory.surface(frame))
        torch.testing.assert_close(field.distances(frame, grid.points()), exact, rtol=0, atol=1e-7)
    assert field.bytes == 4 * 7**3 * 4


def test_a_grid_too_coarse_for_the_solid_says_that_it_has_no_surface(trajectory: Trajectory, samples: DistanceSamples) -> None:
    coarse = GridField.of(trajectory, Grid(samples.box.lower, samples.box.upper, 2))
    with pytest.raises(ReconstructionError, match="both sides of zero"):
        distances_where_it_may_be(coarse, Grid(samples.box.lower, samples.box.upper, 20)).surface(0)


def test_stored_distances_are_marched_sparsely_with_the_triangles_of_the_whole_grid(samples: DistanceSamples) -> None:
    """Of a large ball and of a small one that moves between the points that are all asked for, and that only slopes find."""
    coarse, grid = Grid(samples.box.lower, samples.box.upper, 12), Grid(samples.box.lower, samples.box.upper, 40)
    places = [coarse.points_at(np.array([(2 * 12 + 2) * 12 + frame + 5])) for frame in range(4)]
    balls = [torch.minimum(coarse.points().norm(dim=1) - 0.03, (coarse.points() - place).norm(dim=1) - 0.012) for place in places]
    field = GridField(torch.stack(balls).reshape(4, 12, 12, 12).numpy(), coarse.lower, coarse.upper)
    asked: list[int] = []
    distances = field.distances

    def recorded(frame: int, points: torch.Tensor) -> torch.Tensor:
        asked.append(len(points))
        return distances(frame, points)

    with mock.patch.object(GridField, "distances", lambda _, frame, points: recorded(frame, points)):
        model = distances_where_it_may_be(field, grid)
        model.surface(0)
        asked.clear()
        for frame in range(4):
            whole = surface_from_values(distances(frame, grid.points()).reshape(grid.shape), grid)
            found = model.surface(frame)
            assert np.array_equal(found.faces, whole.faces)
            np.testing.assert_allclose(found.vertices, whole.vertices, rtol=0, atol=1e-8)
    assert sum(asked) < 4 * 40**3 / 3


@pytest.mark.parametrize("count", [None, 50])
def test_nearest_sample_field_is_knn_1_of_the_frame(trajectory: Trajectory, samples: DistanceSamples, count: int | None) -> None:
    field = NearestSampleField(samples, count)
    queries = torch.rand(300, 3) * 0.1 - 0.05
    for frame in (2, 0, 2):
        kept = samples.kept[frame][np.sort(np.random.default_rng(0).permutation(samples.kept.shape[1])[:count])]
        expected = NearestSample(torch.from_numpy(samples.points), queries).values(torch.from_numpy(samples.distances[frame]), torch.from_numpy(kept))
        assert torch.equal(field.distances(frame, queries), expected)
    kept = 4 * (samples.kept.shape[1] if count is None else count)
    assert 4 * kept < field.bytes <= 16 * kept, "the distances, and the positions by the smaller layout"


def test_more_samples_than_are_kept_are_refused(samples: DistanceSamples) -> None:
    kept = samples.kept.shape[1]
    with pytest.raises(ConfigurationError, match=f"between 1 and the {kept} samples that a frame keeps, found {kept + 1}"):
        NearestSampleField(samples, kept + 1)


def test_network_field_is_the_network_of_that_frame_in_any_number_of_points(trajectory: Trajectory, samples: DistanceSamples) -> None:
    vertices = trajectory.surface_vertices
    shapes = torch.from_numpy(vertices.astype(np.float32))
    networks = Networks(
        ModelSettings(width=8, depth=1, latent=2), shapes, *(torch.from_numpy(corner).float() for corner in (samples.box.lower, samples.box.upper))
    )
    field = NetworkField(networks, vertices)
    points = torch.rand(CHUNK + 5, 3) * 0.1
    with torch.no_grad():
        expected = networks(shapes[3:4], points)[0]
    torch.testing.assert_close(field.distances(3, points), expected, rtol=0, atol=1e-7)
    torch.testing.assert_close(field.distances(3, points[-1:]), expected[-1:], rtol=0, atol=1e-7)
    assert field.bytes == 4 * (networks.decoder.parameter_count + 4 * 2)


def test_surface_of_a_network_is_that_of_the_whole_grid_found_with_fewer_queries(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    networks, box, asked = ball_networks(ball_family), ball_family.samples.box, []
    field = NetworkField(networks, ball_family.trajectory.surface_vertices)
    grid = Grid(box.lower, box.upper, 65)
    model = network_where_it_may_be(field, grid)
    model.surface(0)  # measures the slopes on the whole grid
    values_at = SparseReconstruction.values_at

    def recorded(self: SparseReconstruction, latent: torch.Tensor, indices: np.ndarray) -> np.ndarray:
        asked.append(len(indices))
        return values_at(self, latent, indices)

    monkeypatch.setattr(SparseReconstruction, "values_at", recorded)
    found = model.surface(1)
    whole = surface_from_values(field.distances(1, grid.points()).reshape(grid.shape), grid)
    np.testing.assert_array_equal(found.faces, whole.faces)
    np.testing.assert_allclose(found.vertices, whole.vertices, rtol=0, atol=1e-7)  # chunks of other sizes are rounded otherwise
    assert 0 < sum(asked) < 0.7 * 65**3  # a network is steeper than a distance, and the ball fills much of the box
