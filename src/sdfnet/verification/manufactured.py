"""Motions chosen first, with the loads that cause them: how fast the errors fall as mesh and step are refined."""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64
from scipy.sparse import csr_matrix, diags, eye, kron

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import FixedComponents, NodalForce, NodalStart
from sdfnet.physics.effects.history import History
from sdfnet.physics.elasticity import assemble, body_force, finite_elements
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import plan
from sdfnet.physics.stability import step_limits
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver
from sdfnet.verification.conservation import masses_of
from sdfnet.verification.function_norm import relative_l2_error
from sdfnet.verification.meshes import box, small_box
from sdfnet.verification.row import Row, absolute, fitted_order

ORDER_TOLERANCE = 0.2  # NUMERICS
PHASE = 0.5  # at time 0, so that neither displacement nor acceleration vanishes there
AMPLITUDES = np.array([1.0, -0.5, 0.7])  # of the chosen displacement along x, y, z
CELLS = {"P1": (4, 6, 8, 10), "P2": (2, 3, 4, 5)}  # along a side
SPACE_ORDERS = {"P1": 2.0, "P2": 3.0}
SPACE_STEPS = 100  # over an eighth of a period: Newmark's relative error, (omega h)^2 / 12, is 5e-6, a hundredth of the smallest in space
# The last two err only by the lines that stand for the sine.
TIME_ORDERS = {"symplectic_euler": 1.0, "leapfrog": 2.0, "newmark": 2.0, "modal": 2.0, "exact": 2.0}
TIME_STEPS = (80, 160, 320, 640)  # over three quarters of a period, which is half the coarsest step's stability limit 80 times

NodalField = Float64[np.ndarray, "nodes 3"]


def manufactured() -> Iterator[Row]:
    """u = U(x) sin(omega t + 1/2): orders of the error, fitted by least squares over four meshes and over four steps."""
    for name, length, material in (("soft", 1.0, Material()), ("steel", 0.1, Material(2.1e11, 0.29, 7850.0))):
        for element, cells in CELLS.items():
            found = fitted_order([1 / count for count in cells], [_space_error(element, count, length, material) for count in cells])
            setup = f"{element}, {cells[0]} to {cells[-1]} cells, {name}"
            yield absolute(setup, "order of the L2 error in space", SPACE_ORDERS[element], found, ORDER_TOLERANCE)
    for integrator in INTEGRATORS:
        for mass in masses_of(integrator):
            found = fitted_order([1 / steps for steps in TIME_STEPS], [_time_error(integrator, mass, steps) for steps in TIME_STEPS])
            setup = f"{integrator}, {mass}, {TIME_STEPS[0]} to {TIME_STEPS[-1]} steps"
            yield absolute(setup, "order of the error in time", TIME_ORDERS[integrator], found, ORDER_TOLERANCE)


def _space_error(element: str, cells: int, length: float, material: Material) -> float:
    """||u_h - u|| / ||u|| in L2 after an eighth of a period, in a cube that is a quarter of a wave along each side.

    With k = pi / 2L, S = sin(kx) cos(ky) cos(kz) and so on along y and z, U = a S needs the force density
    -rho omega^2 U - mu laplace U - (lambda + mu) grad div U = (3 mu k^2 - rho omega^2) U + (lambda + mu) k^2 (a1 + a2 + a3) S,
    times sin(omega t + 1/2). The boundary is held along the components of U that vanish there, and free along the others.
    """
    k = math.pi / (2 * length)
    omega, eighth = k * material.pressure_wave_speed, math.pi / (4 * k * material.pressure_wave_speed)  # later the solid's own vibrations would hide the order

    def wave(points: NodalField) -> NodalField:
        sine, cosine = np.sin(k * points), np.cos(k * points)
        field: np.ndarray = np.stack([sine[:, i] * cosine[:, j] * cosine[:, m] for i, j, m in ((0, 1, 2), (1, 2, 0), (2, 0, 1))], axis=1)
        return field

    def displacement(points: NodalField) -> NodalField:
        return AMPLITUDES * wave(points)

    def density(points: NodalField) -> NodalField:
        of_volume = (material.lame_lambda + material.lame_mu) * k**2 * AMPLITUDES.sum()
        return (3 * k**2 * material.lame_mu - material.density * omega**2) * displacement(points) + of_volume * wave(points)

    axis = np.linspace(0, length, cells + 1)
    mesh = box(axis, axis, axis)
    elements = finite_elements(mesh, element)
    at_start, at_end = elements.nodes == 0, elements.nodes == length
    held = at_start | (at_end.any(axis=1, keepdims=True) & ~at_end) | (at_end.sum(axis=1, keepdims=True) > 1)
    motion = (body_force(elements, density), displacement(elements.nodes), omega)
    found = _driven(mesh, material, Solver("newmark", "consistent", element), held, motion, eighth, SPACE_STEPS)
    end = math.sin(omega * eighth + PHASE)
    return relative_l2_error(elements, found, lambda points: end * displacement(points))


def _time_error(integrator: str, mass: str, steps: int) -> float:
    """The largest error over the largest displacement of a motion that the discrete solid makes exactly: f = (K - omega^2 M) U sin(omega t + 1/2)."""
    mesh, material = small_box(), Material()
    model = assemble(mesh, material)
    held = np.repeat(mesh.nodes[:, 2:] == 0, 3, axis=1)
    duration = 0.5 * TIME_STEPS[0] * step_limits(model, held).of(mass)
    omega = 1.5 * math.pi / duration
    scalar = csr_matrix(diags(model.lumped_mass)) if mass == "lumped" else model.consistent_mass
    shape = np.where(held, 0.0, np.sin(mesh.nodes @ np.array([[1.0, 0.3, -0.2], [0.4, -1.0, 0.5], [0.8, 0.6, 0.9]])))
    force = ((model.stiffness - omega**2 * kron(scalar, eye(3))) @ shape.ravel()).reshape(-1, 3)
    found = _driven(mesh, material, Solver(integrator, mass, modes=1000), held, (force, shape, omega), duration, steps)
    exact = math.sin(omega * duration + PHASE) * shape
    return float(np.abs(found - exact).max() / np.abs(shape).max())


def _driven(
    mesh: TetMesh, material: Material, solver: Solver, held: np.ndarray, motion: tuple[NodalField, NodalField, float], duration: float, steps: int
) -> NodalField:
    """The displacement at the end (m), from the state and under the force of (force, shape, omega) times sin(omega t + 1/2)."""
    force, shape, omega = motion
    times = np.linspace(0, duration, steps + 1)  # at these the history is exact, and lines between them err as the methods may
    history = History(tuple(times.tolist()), tuple(np.sin(omega * times + PHASE).tolist()))
    effects: dict[str, Effect] = {
        "held": FixedComponents(held),
        "drive": NodalForce(force, history),
        "start": NodalStart(math.sin(PHASE) * shape, omega * math.cos(PHASE) * shape),
    }
    timed = Solver(solver.integrator, solver.mass, solver.element, time_step=duration / steps, modes=solver.modes)
    integrator, _ = plan(Scene(Geometry(), effects, material, Recording(duration, 2), timed), mesh).compile()
    state = integrator.initial_state()
    integrator.advance(state, steps)
    return integrator.motion.nodal(state.displacement).numpy()
