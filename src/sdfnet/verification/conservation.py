"""What must be kept: rest under rigid motion, mass, momentum, and energy."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import FixedComponents, NodalStart
from sdfnet.physics.elasticity import finite_elements
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.statics import rigid_motions
from sdfnet.physics.vibration import natural_frequencies
from sdfnet.scene import SOLVER_CHOICES, Effect, Geometry, Material, Recording, Scene, Solver
from sdfnet.verification.meshes import jittered_box, small_box
from sdfnet.verification.row import Row, absolute, relative

ELEMENTS = SOLVER_CHOICES["element"]
ROOT_OF_ROUNDING = 1e-4  # a zero of K comes out as the root of rounding, 1e-8 of the fastest mode: some 1e-7 of the seventh
STEPS = 10_000
SHORT = 200  # in so many a drifting solid comes so far that its rigid motion, times the rounding of the stiffness, is a force of 1e-12
KEPT = 1e-11  # NUMERICS: of the energy over so many steps
STRIDES = {"modal": 1, "exact": 20}  # steps in one call; the others take them one by one in any case, modal's exponential of ten keeps 1e-10 alone
SHARE_OF_LIMIT = 0.99  # the step, in stability limits of leapfrog


def masses_of(integrator: str) -> tuple[str, ...]:
    """The kinds of mass that an integrator takes."""
    return ("lumped",) if "a consistent mass" in INTEGRATORS[integrator].refuses else ("lumped", "consistent")


VARIANTS = [  # integrator, mass, element: every integrator, with both masses where it takes both, and on every element
    *[(integrator, mass, "P1") for integrator in INTEGRATORS for mass in masses_of(integrator)],
    ("leapfrog", "lumped", "P1_nodal_pressure"),
    ("leapfrog", "lumped", "P2"),
    ("newmark", "consistent", "P2"),
]


def free_rigid_motion() -> Iterator[Row]:
    """Six motions without force, rho V of mass, and the momentum of a free solid that spins and shakes."""
    for name, scale, material in (("soft", 1.0, Material()), ("steel", 0.02, Material(2.1e11, 0.29, 7850.0))):
        mesh, mass = jittered_box(scale), material.density * 2 * 1 * 1.5 * scale**3
        for element in ELEMENTS:
            setup = f"{element}, {name}"
            compiled = plan(Scene(Geometry(), {}, material, solver=Solver("newmark", "consistent", element)), mesh)
            model = compiled.model
            size = float(abs(model.stiffness).sum(axis=1).max())
            motions = rigid_motions(model.elements.nodes).reshape(6, -1)
            worst = max(abs(float(u @ (model.stiffness @ u))) / (size * float(u @ u)) for u in motions)
            yield absolute(setup, "u'Ku / |K| u'u, worst of six motions", 0.0, worst, 1e-12)  # NUMERICS
            yield relative(setup, "sum of the lumped mass", mass, float(model.lumped_mass.sum()), 1e-12, "kg")
            yield relative(setup, "sum of the consistent mass", mass, float(model.consistent_mass.sum()), 1e-12, "kg")
            frequencies = natural_frequencies(compiled, 7).frequencies
            yield absolute(setup, "sixth frequency over the seventh", 0.0, float(frequencies[5] / frequencies[6]), ROOT_OF_ROUNDING)
    for integrator, kind, element in VARIANTS:
        lost = _momentum_lost(_shaking(integrator, kind, element, {}))
        yield absolute(f"{integrator}, {kind}, {element}", f"momentum lost in {SHORT} steps", 0.0, lost, KEPT)


def energy() -> Iterator[Row]:
    """What an integrator keeps without a load, its step at 0.99 of leapfrog's limit."""
    for integrator, kind, element in VARIANTS:
        foot = FixedComponents(np.repeat(finite_elements(small_box(), element).nodes[:, 2:] == 0, 3, axis=1))
        lost = _energy_lost(_shaking(integrator, kind, element, {"foot": foot}))
        yield absolute(f"{integrator}, {kind}, {element}", f"energy lost in {STEPS:,} steps", 0.0, lost, KEPT)


def shaken(mesh: TetMesh, element: str) -> NodalStart:
    """Every node with a velocity of its own (m/s), and a place (m)."""
    shape, random = finite_elements(mesh, element).nodes.shape, np.random.default_rng(5)
    return NodalStart(1e-3 * random.standard_normal(shape), random.standard_normal(shape))


def _shaking(integrator: str, mass: str, element: str, effects: dict[str, Effect]) -> Plan:
    """A small box that starts with a random motion; one frame, as many steps as are asked of it."""
    mesh, material = small_box(), Material()
    effects = effects | {"shake": shaken(mesh, element)}
    limits = plan(Scene(Geometry(), effects, material, solver=Solver("leapfrog", mass, element)), mesh).limits
    assert limits is not None
    step = SHARE_OF_LIMIT * limits.of(mass)
    solver = Solver(integrator, mass, element, time_step=step, modes=10_000)
    return plan(Scene(Geometry(), effects, material, Recording(duration=step, frames=2), solver), mesh)


def _energy_lost(compiled: Plan) -> float:
    """The largest change of the integrator's energy, looked at every hundredth step, over the first."""
    integrator, _ = compiled.compile()
    state = integrator.initial_state()
    found = [float(integrator.energy(state)[0])]
    stride = STRIDES.get(compiled.scene.solver.integrator, 100)
    for step in range(stride, STEPS + 1, stride):
        integrator.advance(state, stride)
        if step % 100 == 0:
            found.append(float(integrator.energy(state)[0]))
    return float(np.abs(np.array(found) - found[0]).max() / abs(found[0]))


def _momentum_lost(compiled: Plan) -> float:
    """The change of linear and angular momentum (about rest positions, as linear elasticity keeps it) over the largest possible."""
    integrator, _ = compiled.compile()
    motions = rigid_motions(compiled.model.elements.nodes).reshape(6, -1)
    state = integrator.initial_state()

    def momentum() -> Float64[np.ndarray, "6 columns"]:
        moving: Float64[np.ndarray, "6 columns"] = motions @ compiled.equation().mass.product(state.velocity.numpy())
        return moving

    before = momentum()
    scale = float(np.abs(compiled.equation().mass.product(state.velocity.numpy())).sum())
    integrator.advance(state, SHORT)
    return float(np.abs(momentum() - before).max()) / scale
