"""What many load cases in one run cost beside one: python benchmarks/load_cases.py [cases ...]

Pokes at random places of the prepared bunny, a column each. Medians of interleaved repeats.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfnet.data.prepare import prepare_mesh
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.plan import plan
from sdfnet.plugins import find_datasets

STEPS, REPEATS = 50, 7


def main(counts: list[int]) -> None:
    """Print milliseconds per step for each number of load cases."""
    scene = find_datasets()["bunny_poke"].scene
    mesh = prepare_mesh(find_datasets()["bunny_poke"], Path("outputs/data"))
    above = mesh.nodes[mesh.surface_nodes][mesh.nodes[mesh.surface_nodes, 2] > 0.02]
    places = np.random.default_rng(0).choice(above, max(counts), replace=False)
    foot = {"foot": scene.effects["foot"]}
    runs = {}
    for count in counts:
        cases = {f"poke_{k}": PressurePoke(center=tuple(place.tolist()), radius=0.006) for k, place in enumerate(places[:count])}
        integrator, _ = plan(replace(scene, effects=foot, load_cases=cases), mesh).compile()
        runs[count] = integrator, integrator.initial_state(), []
    for _ in range(REPEATS):
        for integrator, state, seconds in runs.values():
            began = time.perf_counter()
            integrator.advance(state, STEPS)
            seconds.append((time.perf_counter() - began) / STEPS)
    alone = float(np.median(runs[counts[0]][2]))
    for count, (_, _, seconds) in runs.items():
        print(f"{count:>4} load cases: {1e3 * np.median(seconds):6.3f} ms per step, {np.median(seconds) / alone:5.2f} times {counts[0]}")


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]] or [1, 2, 4, 8, 16, 32])
