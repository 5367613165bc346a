"""Frames from network to triangles, whole grid beside sparse: python benchmarks/reconstruction.py CHECKPOINT [DATA_FOLDER]

Whole grid: the network at all 100^3 points, then marching cubes. Sparse, first shape: nothing is known of the grid yet but
the slopes; later shapes: what every frame after it costs. The ways take turns, each with a few frames in a row, as an animation
asks for them: the first of them pays for the caches that the way before has emptied. Medians; then all frames, compared bit by bit.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from sdfnet.data.store import read_distances, read_trajectory
from sdfnet.evaluation.reconstruct import Grid, surface_from_values, values_of_frames
from sdfnet.evaluation.sparse import SparseValues
from sdfnet.evaluation.sparse_network import SparseReconstruction
from sdfnet.models.networks import RECORD, load_networks, read_checkpoint

TURNS = 8
IN_A_ROW = 4


def main(checkpoint: Path, folder: Path) -> None:
    """Print milliseconds of network and marching cubes, the ratio, the points asked, and in how many frames the triangles are identical."""
    record, networks = read_checkpoint(checkpoint)[RECORD], load_networks(checkpoint).eval()
    trajectory, samples = read_trajectory(folder / record["trajectory"]), read_distances(folder / record["distances"])
    grid, decoder = Grid(samples.box.lower, samples.box.upper), networks.decoder
    latents = networks.latents(torch.from_numpy(trajectory.surface_vertices.astype(np.float32)))
    began = time.perf_counter()
    later = SparseReconstruction.measured(decoder, grid, latents)
    print(f"slopes {', '.join(f'{slope:.3f}' for slope in later.slopes)}, measured in {time.perf_counter() - began:.2f} s; {torch.get_num_threads()} threads")

    def whole(latent: torch.Tensor) -> SparseValues:
        return SparseValues(values_of_frames(lambda points: decoder(latent[None], points), grid)[0].numpy(), (0, 0, 0), grid.resolution**3)

    ways: dict[str, Callable[[torch.Tensor], SparseValues]] = {
        "whole grid": whole,
        "sparse, first shape": lambda latent: SparseReconstruction(decoder, grid, later.slopes).values(latent),
        "sparse, later shapes": later.values,
    }
    seconds: dict[str, list[tuple[float, float]]] = {way: [] for way in ways}
    for turn in range(-1, TURNS):  # one to warm up
        for way, values in ways.items():
            for frame in range(turn * IN_A_ROW, (turn + 1) * IN_A_ROW):
                began = time.perf_counter()
                found = values(latents[frame % len(latents)])
                between = time.perf_counter()
                surface_from_values(torch.from_numpy(found.values), grid, found.start)
                if turn >= 0:
                    seconds[way].append((between - began, time.perf_counter() - between))
    alone = np.median(np.sum(seconds["whole grid"], axis=1))
    for way, found_seconds in seconds.items():
        total, (network, marching) = np.sum(found_seconds, axis=1), np.median(found_seconds, axis=0)
        print(f"{way:<21} {1e3 * np.median(total):6.1f} ms (p95 {1e3 * np.quantile(total, 0.95):.1f}), of it network {1e3 * network:.1f},", end=" ")
        print(f"marching cubes {1e3 * marching:.1f}; {alone / np.median(total):.1f} times as fast as the whole grid")
    identical, asked = 0, []
    for latent in latents:
        expected = surface_from_values(torch.from_numpy(whole(latent).values), grid)
        found = later.values(latent)
        surface = surface_from_values(torch.from_numpy(found.values), grid, found.start)
        asked.append(found.asked)
        identical += np.array_equal(surface.faces, expected.faces) and np.array_equal(surface.vertices, expected.vertices)
    print(f"identical triangles, bit by bit, in {identical} of {len(latents)} frames; {np.mean(asked):.0f} of {grid.resolution**3} points asked")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "outputs/data"))
