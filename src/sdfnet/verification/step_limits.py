"""Where explicit steps cease to be stable: just under the limit they go on for ever, just over it they are stopped."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from sdfnet.physics.effects.arrays import FixedComponents, NodalStart
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.simulate import SimulationStopped, run
from sdfnet.physics.vibration import natural_frequencies
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver
from sdfnet.verification.conservation import KEPT, shaken
from sdfnet.verification.meshes import box, small_box
from sdfnet.verification.row import Row, absolute, between, relative

LONG, CAUGHT_BEFORE = 10_000, 200  # NUMERICS: steps that must stay finite, and steps before which a run over the limit must be stopped
VARIANTS = [
    *[(integrator, mass, "P1") for integrator in ("symplectic_euler", "leapfrog") for mass in ("lumped", "consistent")],
    ("leapfrog", "lumped", "P1_nodal_pressure"),
    ("leapfrog", "lumped", "P2"),
    ("leapfrog", "consistent", "P2"),
]
LANCZOS = 1e-6  # relative: where the search for omega_max stops
TRIAL_STEPS, GROWTH = 1000, 1e3  # half a percent over the limit an amplitude grows by more than this in so many steps
BISECTIONS = 12  # from a factor of 3 between stable and unstable to under 0.1 percent


def step_limit() -> Iterator[Row]:
    """h = 2 / omega_max: 0.99 of it for 1e4 steps keeps the energy, 1.01 of it is stopped by the energy watch."""
    for index, (integrator, mass, element) in enumerate(VARIANTS):
        material = (Material(), Material(2.1e11, 0.29, 7850.0))[index % 2]
        mesh = small_box()
        effects: dict[str, Effect] = {"foot": Pinned(), "shake": shaken(mesh, element)}
        compiled = plan(Scene(Geometry(), effects, material, solver=Solver(integrator, mass, element)), mesh)
        setup = f"{integrator}, {mass}, {element}"
        yield relative(setup, "limit beside 2 / omega_max", 2 / _largest_frequency(compiled), _limit(compiled), LANCZOS, "s")
        yield absolute(setup, f"energy lost at 0.99 in {LONG:,} steps", 0.0, _energy_lost(_with_step(compiled, 0.99, LONG, 10)), KEPT)
        yield between(
            setup, "step at which 1.01 is stopped", math.nan, _stopped_at(_with_step(compiled, 1.01, 2 * CAUGHT_BEFORE, 40)), (1.0, float(CAUGHT_BEFORE))
        )


def damping() -> Iterator[Row]:
    """Symplectic Euler with damping ratio x: h omega < 2 (sqrt(1 + x^2) - x), on one degree of freedom and for the stiffest mode of a solid."""
    mesh, material = box(np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.1]), np.array([0.0, 0.1])), Material(3e4, 0.3, 2.0)
    all_but_one = np.ones(mesh.nodes.shape, dtype=np.bool_)
    all_but_one[-1, 0] = False
    wall = np.repeat(mesh.nodes[:, :1] == 0, 3, axis=1)
    for name, held in (("one degree of freedom", all_but_one), ("solid", wall)):
        effects: dict[str, Effect] = {"held": FixedComponents(held), "shake": NodalStart(velocity=np.ones(mesh.nodes.shape))}
        scene = Scene(Geometry(), effects, material, solver=Solver("symplectic_euler"))
        omega = _largest_frequency(plan(scene, mesh))
        for ratio in (0.02, 0.5):
            for kind, damped in (("mass", RayleighDamping(mass=2 * ratio * omega)), ("stiffness", RayleighDamping(stiffness=2 * ratio / omega))):
                compiled = plan(replace(scene, effects=effects | {"damping": damped}), mesh)
                exact = 2 * (math.sqrt(1 + ratio**2) - ratio) / omega
                setup = f"{name}, damped by the {kind}, x = {ratio:g}"
                yield relative(setup, "step from which the motion grows", exact, _limit_of_growth(compiled, exact), 0.01, "s")  # NUMERICS
                yield relative(setup, "limit that the plan takes", exact, _limit(compiled), LANCZOS, "s")


def _limit(compiled: Plan) -> float:
    """The stability limit that the plan keeps, s."""
    assert compiled.limits is not None
    return compiled.limits.of(compiled.scene.solver.mass)


def _largest_frequency(compiled: Plan) -> float:
    """omega_max of all modes by the dense solver, 1/s."""
    return float(natural_frequencies(compiled, int((~compiled.fixed).sum())).angular_frequencies[-1])


def _with_step(compiled: Plan, share: float, steps: int, frames: int) -> Plan:
    """The same with a step of so much of the limit, which `plan` would refuse over 1; `frames` looks of the energy watch."""
    duration = share * _limit(compiled) * steps
    return replace(compiled, scene=replace(compiled.scene, recording=Recording(duration, frames + 1)), steps_per_frame=steps // frames)


def _energy_lost(compiled: Plan) -> float:
    """The drift that the energy watch saw, infinite when it stopped the run."""
    try:
        return float(run(compiled).report["energy_drift"])
    except SimulationStopped:
        return math.inf


def _stopped_at(compiled: Plan) -> float:
    """The step at which a run is stopped, infinite when it is not."""
    try:
        run(compiled)
    except SimulationStopped as stop:
        return float(len(stop.trajectory.times) * compiled.steps_per_frame)
    return math.inf


def _limit_of_growth(compiled: Plan, about: float) -> float:
    """The step (s) from which on the motion grows, between 0.6 and 1.8 of `about`, by bisection."""
    motion = compiled.equation()

    def grows(step: float) -> bool:
        integrator = INTEGRATORS[compiled.scene.solver.integrator](motion, step)
        state = integrator.initial_state()
        integrator.advance(state, TRIAL_STEPS)
        size = float(state.displacement.abs().max())
        return not size < GROWTH * step * float(np.abs(motion.velocity).max())

    return _bisected(grows, 0.6 * about, 1.8 * about)


def _bisected(is_over: Callable[[float], bool], low: float, high: float) -> float:
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if is_over(middle) else (middle, high)
    return (low + high) / 2
