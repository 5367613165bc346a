"""What each effect costs per step on the bunny, and the plans of three scenes: python benchmarks/effects.py

Every effect is added to the paper's poke by itself. Steps with and without it are interleaved; medians. The first row is
a loop of three lines with the same matrix: what the paper's scene would cost if no other effect had been written.
Then what the checks after every frame add to its steps: frames with and without them interleaved, medians.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sdfnet.data.prepare import prepare_mesh
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.prestrain import Prestrain
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.effects.rigid_finger import RigidFinger
from sdfnet.physics.effects.traction import Traction
from sdfnet.physics.energy_watch import is_finite
from sdfnet.physics.integrators.integrator import torch_csr
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import Ball
from sdfnet.plugins import find_datasets
from sdfnet.scene import Scene

STEPS, REPEATS, FRAMES = 40, 9, 60
NOSE = (0.0, -0.024, 0.086)


class HandWritten:
    """v += h M^-1 (f - K u), u += h v, and nothing else."""

    def __init__(self, scene: Scene, mesh) -> None:
        compiled = plan(scene, mesh)
        motion, self.h = compiled.equation(), compiled.time_step
        inverse = 1 / motion.mass.matrix().diagonal()
        self.matrix = torch_csr((-self.h * motion.stiffness.multiply(inverse[:, None])).tocsr())
        self.load = torch.from_numpy(self.h * inverse[:, None] * motion.constant_force)
        self.u, self.v = torch.zeros_like(self.load), torch.zeros_like(self.load)

    def advance(self, steps: int) -> None:
        """Take so many steps."""
        for _ in range(steps):
            self.v.addmm_(self.matrix, self.u).add_(self.load)
            self.u.add_(self.v, alpha=self.h)


def main() -> None:
    """Print the table and the plans."""
    dataset = find_datasets()["bunny_poke"]
    scene, mesh = dataset.scene, prepare_mesh(dataset, Path("outputs/data"))
    added = {
        "gravity": Gravity(),
        "rayleigh_damping, mass part": RayleighDamping(mass=10.0),
        "rayleigh_damping, both parts": RayleighDamping(mass=10.0, stiffness=1e-7),
        "traction": Traction(region=Ball(center=NOSE, radius=0.01), traction=(100.0, 0.0, 0.0)),
        "traction, ramped": Traction(region=Ball(center=NOSE, radius=0.01), traction=(100.0, 0.0, 0.0), history=ramp(0.005)),
        "initial_motion": InitialMotion(velocity=(0.0, 0.1, 0.0)),
        "prestrain": Prestrain(strain=(0.01, 0.01, 0.01, 0.0, 0.0, 0.0)),
        "floor_contact": FloorContact(height=-0.02),
        "rigid_finger": RigidFinger(center=(-0.004, -0.024, 0.086), direction=(1.0, 0.0, 0.0), speed=1.0, travel=0.005),
        "finite_strain": FiniteStrain(),
    }
    without = plan(scene, mesh)
    runs = {"the paper's scene": _advance(without), "the same by hand": HandWritten(scene, mesh).advance}
    limits = {}
    for name, effect in added.items():
        compiled = plan(replace(scene, effects={**scene.effects, "added": effect}), mesh)
        runs[name], limits[name] = _advance(compiled), compiled.time_step / without.time_step
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(REPEATS):
        for name, advance in runs.items():
            began = time.perf_counter()
            advance(STEPS)
            seconds[name].append((time.perf_counter() - began) / STEPS)
    base = float(np.median(seconds["the paper's scene"]))
    print(f"{'scene':<34}{'ms per step':>12}{'ratio':>8}{'step':>8}")
    for name, values in seconds.items():
        print(f"{name:<34}{1e3 * np.median(values):>12.3f}{np.median(values) / base:>8.2f}{limits.get(name, 1.0):>8.2f}")
    print("\n".join(_checks(without)))
    poke, foot = scene.effects["poke"], scene.effects["foot"]
    scenes = {
        "the paper's poke": scene.effects,
        "poke with gravity, damping and floor": {
            "foot": foot,
            "poke": poke,
            "gravity": added["gravity"],
            "damping": added["rayleigh_damping, both parts"],
            "floor": added["floor_contact"],
        },
        "finite strain with a moving finger": {"foot": foot, "finger": added["rigid_finger"], "strain": added["finite_strain"]},
    }
    for name, effects in scenes.items():
        print(f"\n=== {name}\n{plan(replace(scene, effects=effects), mesh).describe()}")


def _advance(compiled):
    integrator, _ = compiled.compile()
    state = integrator.initial_state()
    return lambda steps: integrator.advance(state, steps)


def _checks(compiled) -> list[str]:
    """A line for the finite check alone, and one for all that the energy watch asks."""
    integrator, watch = compiled.compile()
    state = integrator.initial_state()
    watch.problem(state)
    checks = {"steps alone": lambda: None, "finite checks": lambda: is_finite(state), "finite and energy checks": lambda: watch.problem(state)}
    seconds: dict[str, list[float]] = {name: [] for name in checks}
    for _ in range(FRAMES):
        for name, check in checks.items():
            began = time.perf_counter()
            integrator.advance(state, compiled.steps_per_frame)
            check()
            seconds[name].append(time.perf_counter() - began)
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    base = medians["steps alone"]
    return [f"{f'a frame: {name}':<34}{1e3 * value:>12.3f} ms{100 * (value / base - 1):>8.2f} % more" for name, value in medians.items()]


if __name__ == "__main__":
    main()
