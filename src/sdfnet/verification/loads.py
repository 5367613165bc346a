"""Loads whose answer is known by hand: weight that lets a free solid fall, and pushes that come and go within a step."""

import math
from collections.abc import Iterator

import numpy as np

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import FixedComponents, NodalForce
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.history import History
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.integrators.integrator import Integrator, State
from sdfnet.physics.plan import plan
from sdfnet.physics.simulate import run
from sdfnet.scene import SOLVER_CHOICES, Effect, Geometry, Material, Recording, Scene, Solver
from sdfnet.verification.conservation import masses_of
from sdfnet.verification.manufactured import ORDER_TOLERANCE, TIME_ORDERS
from sdfnet.verification.meshes import box, small_box
from sdfnet.verification.row import Row, absolute, fitted_order, relative

RIGID = 1e-11  # NUMERICS: of the drop; lumped quadratic tets under the integral of rho g v deform by 1e-3 of it here
TRANSITS = 5.0  # of sound through the falling solid: long enough to answer its load, short enough for the answer to be seen beside the drop
ROUNDING = 1e-12  # NUMERICS
STEPS = (20, 40, 80, 160)
SPAN = 2.0  # radians of the vibration
BEGIN, RISE = 1 / 3, 1e-5  # of the time: never at a step's end and at the same place within one, over in a six hundredth of the shortest


def free_fall() -> Iterator[Row]:
    """A free solid under its weight: every node falls by g t^2 / 2, whatever the elements and the mass."""
    for name, scale, material in (("soft", 1.0, Material(1.0, 0.3, 1.0)), ("steel", 0.02, Material(2.1e11, 0.29, 7850.0))):
        mesh, gravity = box(scale * np.array([0.0, 1.1, 2.0]), scale * np.array([0.0, 0.4, 1.0]), scale * np.array([0.0, 0.8, 1.5])), 9.81
        duration = TRANSITS * mesh.diagonal / material.pressure_wave_speed
        drop = gravity * duration**2 / 2
        for element in SOLVER_CHOICES["element"]:
            for mass in SOLVER_CHOICES["mass"]:
                scene = Scene(Geometry(), {"weight": Gravity((0.0, 0.0, -gravity))}, material, Recording(duration, 2), Solver("leapfrog", mass, element))
                fallen = run(plan(scene, mesh)).displacements[-1]
                setup = f"{element}, {mass}, {name}"
                yield relative(setup, "drop", drop, -float(fallen[:, 2].mean()), RIGID, "m")
                yield absolute(setup, "deformation over the drop", 0.0, float(np.abs(fallen - fallen.mean(axis=0)).max()) / drop, RIGID)


def sudden_load() -> Iterator[Row]:
    """m u'' + k u = p, p rising from 0 to F within r from time b on: u = F/k (1 - [sin w(t - b) - sin w(t - b - r)] / w r), w^2 = k/m."""
    for name, length, material in (("soft", 0.1, Material()), ("steel", 0.02, Material(2.1e11, 0.29, 7850.0))):
        for integrator, kind in INTEGRATORS.items():
            for mass in masses_of(integrator):
                setup = f"{integrator}, {mass}, {name}"
                if kind.is_exact_in_time:
                    yield absolute(
                        f"{setup}, one step", "error after a rise within a step", 0.0, _error_after_rise(integrator, mass, length, material, 1), ROUNDING
                    )
                else:
                    errors = [_error_after_rise(integrator, mass, length, material, steps) for steps in STEPS]
                    found = fitted_order([1 / steps for steps in STEPS], errors)
                    yield absolute(
                        f"{setup}, {STEPS[0]} to {STEPS[-1]} steps", "order after a rise within a step", TIME_ORDERS[integrator], found, ORDER_TOLERANCE
                    )


def blow_within_a_step() -> Iterator[Row]:
    """A free solid that a short blow sets in motion has the blow's impulse, the integral of p dt, as its momentum."""
    for integrator in INTEGRATORS:
        for mass in masses_of(integrator):
            yield relative(f"{integrator}, {mass}", "momentum over the impulse of a blow within a step", 1.0, _momentum_after_blow(integrator, mass), ROUNDING)


def _error_after_rise(integrator: str, mass: str, length: float, material: Material, steps: int) -> float:
    """The error of the one free component after SPAN of its vibration, over F/k."""
    side = np.array([0.0, length])
    mesh = box(side, side, side)
    held = np.ones(mesh.nodes.shape, dtype=np.bool_)
    held[-1, 0] = False
    alone: dict[str, Effect] = {"held": FixedComponents(held)}
    motion = plan(Scene(Geometry(), alone, material, solver=Solver("newmark", mass)), mesh).equation()
    stiffness, inertia = float(motion.stiffness[0, 0]), float(motion.mass.matrix()[0, 0])
    omega = math.sqrt(stiffness / inertia)
    duration = SPAN / omega
    begin, rise = BEGIN * duration, RISE * duration
    push = NodalForce(np.where(held, 0.0, 1.0), History((begin, begin + rise), (0.0, 1.0)))
    integrated, state = _stepped(alone | {"push": push}, mesh, material, Solver(integrator, mass, modes=1, time_step=duration / steps), steps)
    half = omega * rise / 2
    swing = math.cos(omega * (duration - begin) - half) * math.sin(half) / half  # the difference of the sines, which would cancel
    return abs(float(state.displacement[0, 0]) * stiffness - (1 - swing))


def _momentum_after_blow(integrator: str, mass: str) -> float:
    """Of a free solid that a triangle in time, a tenth of a step long, has set in motion, over what it has to be."""
    mesh, material, steps = small_box(), Material(), 10
    limits = plan(Scene(Geometry(), {}, material), mesh).limits
    assert limits is not None
    step = 0.5 * limits.of(mass)
    begin, top, end, peak = 3.37 * step, 3.41 * step, 3.47 * step, 2.0
    blow, area = History((begin, top, end), (0.0, peak, 0.0)), peak * (end - begin) / 2  # of the triangle, s
    force = np.outer(np.sin(mesh.nodes @ np.array([1.0, 0.3, -0.2])) + 2.0, [1.0, 0.0, 0.0])
    integrated, state = _stepped({"blow": NodalForce(force, blow)}, mesh, material, Solver(integrator, mass, modes=10_000, time_step=step), steps)
    momentum = integrated.motion.mass.product(state.velocity.numpy()).reshape(-1, 3)[:, 0].sum()
    return float(momentum / (force.sum() * area))


def _stepped(effects: dict[str, Effect], mesh: TetMesh, material: Material, solver: Solver, steps: int) -> tuple[Integrator, State]:
    """The state after so many of the solver's steps."""
    integrator, _ = plan(Scene(Geometry(), effects, material, Recording(steps * float(solver.time_step), 2), solver), mesh).compile()
    state = integrator.initial_state()
    integrator.advance(state, steps)
    return integrator, state
