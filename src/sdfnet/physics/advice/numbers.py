"""The dimensionless numbers of a scene: what a handbook would ask before it chose a theory."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.doubts import LARGEST_LINEAR_STRAIN, LOCKING_POISSON_RATIO
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.elasticity import displacement_gradients
from sdfnet.physics.plan import Plan
from sdfnet.scene import Material

SMALLEST_CHANGE = 0.05  # of the displacements: linear tets of usual size err by as much themselves
SMALLEST_LOSS = 2 * SMALLEST_CHANGE  # of the amplitude by the end: half of it is lost on average over a run
LARGEST_LINEAR_SAG = 0.01  # of the length under its own weight
QUIET_TRANSITS = 100.0  # of sound across the solid: some ten periods of its slowest mode, time for a slow load to be followed at rest
EDGES_PER_PATCH = 5.0  # edges per radius with which linear tets meet the dent under a disc to 8 % (NUMERICS, disc on half-space)


@dataclass(frozen=True)
class Number:
    """A dimensionless number and the value beyond which it speaks for an effect."""

    name: str  # with its formula
    value: float
    threshold: float


@dataclass(frozen=True)
class Deformation:
    """The most that happens to any tet or node of a motion."""

    gradient: float  # Frobenius norm of grad u
    rotation: float  # of the polar decomposition of 1 + grad u, radians
    speed: float  # m/s, from frame to frame


def deformation(mesh: TetMesh, displacements: Float64[np.ndarray, "frames nodes 3"], times: Float64[np.ndarray, " frames"]) -> Deformation:
    """Of all frames; the rotation of the frame whose antisymmetric part of grad u is the largest."""
    largest, most_turned, turning = 0.0, np.zeros((len(mesh.tets), 3, 3)), 0.0
    for gradient in displacement_gradients(mesh, displacements):
        largest = max(largest, float(np.square(gradient).sum(axis=(1, 2)).max()))
        skew = float(np.square(gradient - gradient.transpose(0, 2, 1)).sum(axis=(1, 2)).max())
        if skew > turning:
            most_turned, turning = gradient, skew
    left, _, right = np.linalg.svd(most_turned + np.eye(3))
    handed = np.sign(np.linalg.det(left @ right))
    left[:, :, 2] *= handed[:, None]
    cosine = (np.trace(left @ right, axis1=1, axis2=2) - 1) / 2
    speed = np.linalg.norm(np.diff(displacements, axis=0), axis=2).max() / np.diff(times).min()
    return Deformation(float(np.sqrt(largest)), float(np.arccos(np.clip(cosine, -1, 1)).max()), float(speed))


def strain_numbers(compiled: Plan, found: Deformation) -> list[Number]:
    """Load strain, indentation under the strongest poke, Cauchy number, rotation, displacement gradient; of several materials the worst."""
    material = compiled.model.material
    modulus = material.youngs_modulus
    dents = [float(np.max(2 * (1 - material.poisson_ratio**2) * strength(poke) / modulus)) for poke in pokes(compiled)]
    return [
        Number("load strain p / E", compiled.demands.stress / float(np.min(modulus)), LARGEST_LINEAR_STRAIN),
        *([Number("patch indentation 2 (1 - nu^2) p / E, of its radius", max(dents), LARGEST_LINEAR_STRAIN)] if dents else []),
        Number("Cauchy number rho v^2 / E", float(np.max(material.density * found.speed**2 / modulus)), LARGEST_LINEAR_STRAIN**2),
        Number("largest rotation, radians", found.rotation, LARGEST_LINEAR_STRAIN),
        Number("largest displacement gradient", found.gradient, LARGEST_LINEAR_STRAIN),
    ]


def weight_numbers(compiled: Plan, weight: float, others: float) -> list[Number]:
    """The stress of the weight, rho g L, beside Young's modulus and beside the pressure of the other loads (Pa)."""
    beside = [Number("rho g L / p", weight / others, SMALLEST_CHANGE)] if others > 0 else []
    return [Number("rho g L / E", weight / float(np.min(compiled.model.material.youngs_modulus)), LARGEST_LINEAR_SAG), *beside]


def element_numbers(compiled: Plan) -> list[Number]:
    """Bulk over shear modulus, and edges per radius of the most coarsely meshed poke."""
    locking = LOCKING_POISSON_RATIO["P1" if compiled.scene.solver.element == "P1_nodal_pressure" else compiled.scene.solver.element]
    material, limit = compiled.model.material, Material(poisson_ratio=locking)
    fineness = [edges_per_radius(compiled.model.mesh, poke) for poke in pokes(compiled)]
    return [
        Number("K / mu", float(np.max(material.bulk_modulus / material.lame_mu)), limit.bulk_modulus / limit.lame_mu),
        *([Number("elements per patch, radius over edge", min(fineness), EDGES_PER_PATCH)] if fineness else []),
    ]


def quadratic_number(change: float) -> Number:
    """What the static answer of quadratic tets to the same elastic forces adds to the displacements."""
    return Number("static answer of P2, change of displacements", change, SMALLEST_CHANGE)


def transits(compiled: Plan) -> Number:
    """How often sound crosses the solid during the run."""
    crossings = compiled.scene.recording.duration * float(np.max(compiled.model.material.pressure_wave_speed)) / compiled.model.mesh.diagonal
    return Number("transits T c / L", crossings, QUIET_TRANSITS)


def gap(compiled: Plan, displacements: Float64[np.ndarray, "frames nodes 3"], floor: FloorContact) -> Number:
    """The least height of a free node of the surface over a floor; negative: it would be under it."""
    mesh, normal = compiled.model.mesh, np.asarray(floor.normal, dtype=np.float64) / np.linalg.norm(floor.normal)
    nodes = mesh.surface_nodes[~(compiled.fixed[mesh.surface_nodes] | (normal == 0)).all(axis=1)]
    heights = (mesh.nodes[nodes] + displacements[:, nodes]) @ normal - floor.height
    return Number("gap to floor (z_min - z_floor) / L", float(heights.min(initial=np.inf)) / mesh.diagonal, 0.0)


def pokes(compiled: Plan) -> list[PressurePoke]:
    """The pokes that push, those of load cases included."""
    acting = {**compiled.scene.effects, **compiled.scene.load_cases}
    return [effect for effect in acting.values() if isinstance(effect, PressurePoke) and strength(effect) > 0]


def strength(poke: PressurePoke) -> float:
    """The largest pressure over time, Pa."""
    return abs(poke.pressure) * max(map(abs, poke.history.values))


def edges_per_radius(mesh: TetMesh, poke: PressurePoke) -> float:
    """The radius over the mean edge of the faces under a poke."""
    corners = mesh.nodes[mesh.boundary_faces]
    distances = np.linalg.norm(corners.mean(axis=1) - np.asarray(poke.center), axis=1)
    under = corners[distances <= max(poke.radius, float(distances.min()))]
    return poke.radius / float(np.linalg.norm(under - np.roll(under, 1, axis=1), axis=2).mean())
