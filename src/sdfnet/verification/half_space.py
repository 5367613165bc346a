"""A disc of pressure on a half-space, the textbook's finger: how far a soft solid sinks."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from sdfnet.physics.effects.arrays import NodalForce
from sdfnet.physics.elasticity import finite_elements
from sdfnet.physics.loads import traction_on_patch
from sdfnet.scene import Material
from sdfnet.verification.boundary_values import solution_with_given
from sdfnet.verification.meshes import box
from sdfnet.verification.row import Row, relative

DOWN = np.array([0.0, 0.0, -1.0])
DEPTH = 8  # radii from the disc to the far sides of the mesh: what is left of the disc's shape there is a hundredth of its field

QUADRATURE = 2e-3  # of a disc whose edge cuts faces: some 1,000 points each


@dataclass(frozen=True)
class Sunk:
    """What a disc of pressure does on one mesh."""

    middle: float  # m, how deep the surface lies
    edge: float  # m
    meshed_radius: float  # m, of a disc with the area really loaded
    moment: float  # N m, of the nodal forces on a quarter about the other axis


def disc_on_half_space() -> Iterator[Row]:
    """u0 = 2 (1 - nu^2) p a / E in the middle, 4 (1 - nu^2) p a / (pi E) at the edge (Timoshenko and Goodier, section 139).

    A quarter of the problem, rollers on its planes of symmetry. Elements grow outward, to where the solid is put as a
    point force would have it. The radius is that of the area really loaded. Higher Poisson ratios cost linear tets more.
    """
    for name, radius, material in (("soft", 0.01, Material(8e3, 0.3, 1.0)), ("concrete", 1.0, Material(3e10, 0.2, 2400.0))):
        pressure = 1e-3 * material.youngs_modulus
        for element, per_radius, growth, tolerance in (("P1", 5, 1.3, 0.08), ("P2", 3, 1.75, 0.03)):  # NUMERICS
            found = _sunk(element, per_radius, growth, radius, pressure, material)
            exact = 2 * (1 - material.poisson_ratio**2) * pressure * found.meshed_radius / material.youngs_modulus
            setup = f"{element}, {per_radius} elements per radius, {name}"
            yield relative(setup, "moment of the quarter's load", pressure * radius**3 / 3, found.moment, QUADRATURE, "N m")
            yield relative(setup, "depth in the middle", exact, found.middle, tolerance, "m")
            yield relative(setup, "depth at the edge", exact * 2 / math.pi, found.edge, tolerance, "m")


def point_force(nodes: Float64[np.ndarray, "nodes 3"], force: float, material: Material) -> Float64[np.ndarray, "nodes 3"]:
    """Boussinesq's displacement (m) of the half-space z <= 0 under a force (N) down at the origin, zero there.

    With r from the axis, d the depth and R from the origin: outward F / (4 pi mu) r (d / R^3 - (1 - 2 nu) / (R (R + d))),
    down F / (4 pi mu) (d^2 / R^3 + 2 (1 - nu) / R) (Johnson, Contact Mechanics, equation 3.18).
    """
    nu, distance = material.poisson_ratio, np.linalg.norm(nodes, axis=1)
    depth, distance = -nodes[:, 2], np.where(distance > 0, distance, np.inf)
    outward = depth / distance**3 - (1 - 2 * nu) / (distance * (distance + depth))
    down = depth**2 / distance**3 + 2 * (1 - nu) / distance
    return force / (4 * math.pi * material.lame_mu) * np.stack([outward * nodes[:, 0], outward * nodes[:, 1], -down], axis=1)


def _sunk(element: str, per_radius: int, growth: float, radius: float, pressure: float, material: Material) -> Sunk:
    """A quarter of the disc on cells of a part of its radius (m), which grow from just beyond its edge on."""
    steps = [1.0] * (per_radius + 1)
    while sum(steps) < DEPTH * per_radius:
        steps.append(growth * steps[-1])
    axis = np.concatenate([[0.0], np.cumsum(steps)]) * radius / per_radius
    mesh = box(axis, axis, -axis[::-1])
    elements = finite_elements(mesh, element)

    def loaded(points: Float64[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        is_loaded: np.ndarray = np.linalg.norm(points[:, :2], axis=1) <= radius
        return is_loaded

    corners = mesh.nodes[mesh.boundary_faces]
    patch = traction_on_patch(elements, pressure, loaded, DOWN, (corners[:, :, 2] == 0).all(axis=1) & (corners[:, :, :2].min(axis=1) < radius).all(axis=1))
    is_given = elements.nodes == [0.0, 0.0, np.inf]
    is_given[(elements.nodes[:, 2] == -axis[-1]) | (elements.nodes[:, :2] == axis[-1]).any(axis=1)] = True
    far = point_force(elements.nodes, -4 * float(patch.resultant[2]), material)
    depth = -solution_with_given(mesh, material, element, far, is_given, NodalForce(patch.nodal_force))[:, 2]
    middle, edge = (int(np.linalg.norm(elements.nodes - [x, 0, 0], axis=1).argmin()) for x in (0.0, radius))
    moment = -float(patch.nodal_force[:, 2] @ elements.nodes[:, 0])
    return Sunk(float(depth[middle]), float(depth[edge]), math.sqrt(4 * patch.area / math.pi), moment)
