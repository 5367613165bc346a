"""What accuracy costs in reconstruction: grids from coarse to fine, the whole grid beside the sparse way."""

from itertools import cycle

import torch

from sdfnet.cost.studies import LEAST_SECONDS, Point, Study, interleaved
from sdfnet.data.store import DistanceSamples
from sdfnet.errors import SdfnetError
from sdfnet.evaluation.metrics import surface_errors
from sdfnet.evaluation.reconstruct import Grid, surface_from_values, values_of_frames
from sdfnet.evaluation.settings import EvaluationSettings
from sdfnet.evaluation.sparse import exact_values
from sdfnet.evaluation.sparse_network import SparseReconstruction
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface
from sdfnet.models.networks import Networks
from sdfnet.physics.trajectory import Trajectory

RESOLUTIONS, QUICK_RESOLUTIONS = (32, 48, 64, 100, 144, 200, 256), (32, 64, 100)
SURFACE_SAMPLES = 65_536  # on each of two surfaces that are compared
REPEATS, FEW_REPEATS = 5, 2
DEAR_RESOLUTION = 144  # beyond it the whole grid takes seconds: few repeats
WAYS = ("sparse", "whole grid")  # both find the same triangles, so where one has no surface the other has none


def reconstruction_study(networks: Networks, trajectory: Trajectory, samples: DistanceSamples, quick: bool = False) -> Study:
    """Seconds of the network and marching cubes for one frame, against the error of the grid itself.

    The error is chamfer_l1 of the surface that marching cubes finds in the EXACT distance of the last frame: what the
    resolution costs whatever the network. Both ways are timed one frame after the other as in an animation, from the last
    backwards: the sparse one has its slopes, and of each frame the points that no frame before it asked at are new to it.
    """
    last = len(trajectory.times) - 1
    true = trajectory.surface(last)
    truth = SurfaceDistance(true)
    latents = networks.latents(torch.from_numpy(trajectory.surface_vertices).float())
    points: list[Point] = []
    for resolution in QUICK_RESOLUTIONS if quick else RESOLUTIONS:
        grid = Grid(samples.box.lower, samples.box.upper, resolution)
        overrides = (f"evaluation.resolution={resolution}",)
        try:
            exact = exact_values(truth, grid)
            floor = surface_from_values(torch.from_numpy(exact.values), grid, exact.start)
            error = surface_errors(floor, true, trajectory.mesh.diagonal, SURFACE_SAMPLES, true_distance=truth).chamfer_l1_mm
            points += _timed(networks, latents, grid, error, overrides)
        except SdfnetError as failure:
            points += [Point(way, f"{resolution}^3", overrides=overrides, failure=str(failure)) for way in WAYS]
    title, error_label = "What reconstruction costs", "chamfer L1 of marching cubes on the exact distance, last frame (mm)"
    cost_label, share_of_whole = "network and marching cubes for one frame (s)", 1 / len(trajectory.times)
    return Study("reconstruction", title, error_label, cost_label, tuple(points), share_of_whole)


def _timed(networks: Networks, latents: torch.Tensor, grid: Grid, error: float, overrides: tuple[str, ...]) -> list[Point]:
    repeats = REPEATS if grid.resolution <= DEAR_RESOLUTION else FEW_REPEATS
    sparse = SparseReconstruction.measured(networks.decoder, grid, latents)
    for_sparse, for_whole = cycle(latents.flip(0)), cycle(latents.flip(0))
    ways = {"sparse": lambda: sparse.surface(next(for_sparse)), "whole grid": lambda: _whole(networks, next(for_whole), grid)}
    timings = interleaved(ways, repeats, LEAST_SECONDS)
    counts = {"sparse": sparse.values(latents[-1]).asked, "whole grid": grid.resolution**3}
    return [
        Point(
            way, f"{grid.resolution}^3", error, timings[way], {"network queries": counts[way]},
            is_default=way == "sparse" and grid.resolution == EvaluationSettings().resolution, overrides=overrides if way == "sparse" else (),
        )
        for way in WAYS
    ]  # fmt: skip


def _whole(networks: Networks, latent: torch.Tensor, grid: Grid) -> Surface:
    return surface_from_values(values_of_frames(lambda points: networks.decoder(latent[None], points), grid)[0], grid)
