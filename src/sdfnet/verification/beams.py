"""Bars and beams against the strength of materials: what they bend and how they ring."""

import math
from collections.abc import Iterator

import numpy as np
from scipy.optimize import brentq

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.traction import Traction
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.statics import static_solution
from sdfnet.physics.vibration import natural_frequencies
from sdfnet.scene import Effect, Geometry, Material, Scene, Solver
from sdfnet.verification.meshes import box
from sdfnet.verification.row import Row, between, relative

WALL = Pinned(HalfSpace(normal=(1.0, 0.0, 0.0)))
SHEAR_FACTOR = 5 / 6  # of a rectangle without lateral strain (Timoshenko 1921): the shear stress is a parabola
LOCKED_TIP = (0.75, 0.83)  # of the tip that 40 x 4 x 4 cells of linear tets reach: they can bend only by shearing (NUMERICS)
LOCKED_FREQUENCY = (1.04, 1.155)  # the root of such a stiffness at most; the beam rings in the direction in which its tets' diagonals resist least


def bar_mode() -> Iterator[Row]:
    """Fixed at one end and between rollers: the first omega is pi c_p / 2L, whatever the width."""
    for name, length, material in (("soft", 1.0, Material()), ("steel", 0.3, Material(2.1e11, 0.29, 7850.0))):
        exact = math.pi * material.pressure_wave_speed / (2 * length) / (2 * math.pi)
        for element, count in (("P1", 40), ("P1_nodal_pressure", 40), ("P2", 10)):
            width = np.array([0.0, length / count])
            mesh = box(np.linspace(0, length, count + 1), width, width)
            rollers = Pinned(HalfSpace(point=(length, 0.0, 0.0), normal=(1.0, 0.0, 0.0)), components=(False, True, True), boundary_only=False)
            for mass in ("consistent", "lumped"):
                tolerance = 0.001 if (element, mass) == ("P2", "consistent") else 0.005  # NUMERICS; the lumped mass costs quadratic tets their higher order
                found = _first_frequency({"wall": WALL, "rollers": rollers}, material, Solver("newmark", mass, element), mesh)
                yield relative(f"{element}, {count} elements, {mass} mass, {name}", "first frequency", exact, found, tolerance, "Hz")


def cantilever() -> Iterator[Row]:
    """A square beam of ten times its thickness, nu = 0, under a force at its end: Timoshenko's tip and first frequency.

    P2 finds both. P1 locks: it is a quarter too stiff, and the table must say so.
    """
    for name, thickness, force, material in (("soft", 1.0, 1.0, Material(5e3, 0.0, 1.0)), ("steel", 0.02, 1e3, Material(2.1e11, 0.0, 7850.0))):
        tip, frequency = timoshenko_tip(10 * thickness, thickness, force, material), timoshenko_frequency(10 * thickness, thickness, material)
        for element, cells in (("P2", (20, 2, 2)), ("P1", (40, 4, 4))):
            setup = f"{element}, {cells[0]} x {cells[1]} x {cells[2]} cells, {name}"
            along, across, upright = (np.linspace(0, side * thickness, count + 1) for side, count in zip((10, 1, 1), cells, strict=True))
            mesh = box(along, across, upright)
            solver = Solver("newmark", "consistent", element)
            found_tip, found_frequency = _tip(force, material, solver, mesh), _first_frequency({"wall": WALL}, material, solver, mesh)
            if element == "P2":
                yield relative(setup, "tip", tip, found_tip, 0.01, "m")
                yield relative(setup, "first frequency", frequency, found_frequency, 0.01, "Hz")
            else:
                yield between(f"{setup} (locks)", "tip", tip, found_tip, (LOCKED_TIP[0] * tip, LOCKED_TIP[1] * tip), "m")
                low, high = (part * frequency for part in LOCKED_FREQUENCY)
                yield between(f"{setup} (locks)", "first frequency", frequency, found_frequency, (low, high), "Hz")


def timoshenko_tip(length: float, thickness: float, force: float, material: Material) -> float:
    """F L^3 / (3 E I) + F L / (kappa G A) of a square cantilever, m."""
    inertia, area = thickness**4 / 12, thickness**2
    return force * length**3 / (3 * material.youngs_modulus * inertia) + force * length / (SHEAR_FACTOR * material.lame_mu * area)


def timoshenko_frequency(length: float, thickness: float, material: Material) -> float:
    """The first natural frequency of a square cantilever that shears and whose sections turn, Hz (Huang 1961, clamped-free).

    With b^2 = rho A L^4 omega^2 / (E I), r^2 = I / (A L^2), s^2 = E I / (kappa A G L^2):
    2 + (b^2 (r^2 - s^2)^2 + 2) cosh(b alpha) cos(b beta) = b (r^2 + s^2) / sqrt(1 - b^2 r^2 s^2) sinh(b alpha) sin(b beta).
    """
    inertia, area = thickness**4 / 12, thickness**2
    r2 = inertia / (area * length**2)
    s2 = material.youngs_modulus * inertia / (SHEAR_FACTOR * area * material.lame_mu * length**2)

    def residual(b: float) -> float:
        root = math.sqrt((r2 - s2) ** 2 + 4 / b**2)
        alpha, beta = b * math.sqrt((root - r2 - s2) / 2), b * math.sqrt((root + r2 + s2) / 2)
        left = 2 + (b**2 * (r2 - s2) ** 2 + 2) * math.cosh(alpha) * math.cos(beta)
        return left - b * (r2 + s2) / math.sqrt(1 - b**2 * r2 * s2) * math.sinh(alpha) * math.sin(beta)

    slender = 3.5160  # b of Euler's beam, which neither shears nor turns: the first root lies below it, the second at 22
    b: float = brentq(residual, 0.3 * slender, 1.1 * slender, xtol=1e-12)
    return b * math.sqrt(material.youngs_modulus * inertia / (material.density * area * length**4)) / (2 * math.pi)


def _tip(force: float, material: Material, solver: Solver, mesh: TetMesh) -> float:
    """The mean deflection of the free end under a force spread over it evenly, m."""
    length, width, height = mesh.nodes.max(axis=0).tolist()
    push = Traction(HalfSpace((length, 0.0, 0.0), (-1.0, 0.0, 0.0)), (0.0, 0.0, force / (width * height)))
    compiled = plan(Scene(Geometry(), {"wall": WALL, "push": push}, material, solver=solver), mesh)
    return float(static_solution(compiled)[compiled.model.elements.nodes[:, 0] == length, 2].mean())


def _first_frequency(effects: dict[str, Effect], material: Material, solver: Solver, mesh: TetMesh) -> float:
    return float(natural_frequencies(plan(Scene(Geometry(), effects, material, solver=solver), mesh), 1).frequencies[0])
