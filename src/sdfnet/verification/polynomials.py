"""Exact solutions that are polynomials: the elements that hold them must find them to rounding, the others must not."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import FixedComponents
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.traction import Traction
from sdfnet.physics.elasticity import Field, finite_elements
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.statics import static_solution
from sdfnet.scene import SOLVER_CHOICES, Effect, Geometry, Material, Scene, Solver
from sdfnet.verification.boundary_values import boundary_value_error
from sdfnet.verification.meshes import jittered_box
from sdfnet.verification.row import Row, absolute, between, deviation

ELEMENTS = SOLVER_CHOICES["element"]
# Name, scale of the box, material. Nothing may depend on a size, a stiffness or a density.
SOFT, STEEL = ("soft", 1.0, Material(5e3, 0.4, 1.0)), ("steel", 0.02, Material(2.1e11, 0.29, 7850.0))
ROUNDING = 1e-12  # NUMERICS: of a solve with some hundred unknowns
ROUNDING_OF_PULL = 1e-11  # three corners carry what rounding leaves of balanced forces, and so turn the solid
ROUNDING_OF_QUADRATICS = ROUNDING_OF_PRESSURE = 1e-10  # NUMERICS: coordinates squared; a stiffness of 500 beside 1
LINEAR_ON_QUADRATIC = (0.002, 0.03)  # what linear tets miss of a quadratic displacement on this mesh: about one percent, and it must be seen
DISPLACEMENT = "largest error of the displacement"


def patch() -> Iterator[Row]:
    """u = A x: given on the boundary, and as the answer to the tractions of its stress. Every element holds it."""
    general = 1e-3 * np.array([[0.3, -0.2, 0.1], [0.4, 0.1, 0.7], [-0.5, 0.2, 0.5]])
    upper = np.triu(general)  # vanishes where three corners are held so that the solid can deform as it likes
    for name, scale, material in (SOFT, STEEL):
        mesh = jittered_box(scale)
        for element in ELEMENTS:
            error = boundary_value_error(mesh, material, element, lambda x: x @ general.T)
            yield absolute(f"{element}, {name}, boundary displaced", DISPLACEMENT, 0.0, error, ROUNDING)
            error = deviation(_pulled(mesh, material, element, upper), finite_elements(mesh, element).nodes @ upper.T)
            yield absolute(f"{element}, {name}, boundary pulled", DISPLACEMENT, 0.0, error, ROUNDING_OF_PULL)


def pure_bending() -> Iterator[Row]:
    """u = k (x z, -nu y z, -1/2 [x^2 + nu (z^2 - y^2)]): the only stress is E k z along x."""

    def bent(material: Material) -> Field:
        nu = material.poisson_ratio

        def displacement(points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3"]:
            x, y, z = points.T
            return np.stack([x * z, -nu * y * z, -0.5 * (x**2 + nu * (z**2 - y**2))], axis=1)

        return displacement

    for name, scale, material in (SOFT, STEEL):
        errors = {element: boundary_value_error(jittered_box(scale), material, element, bent(material)) for element in ("P1", "P2")}
        yield absolute(f"P2, {name}", DISPLACEMENT, 0.0, errors["P2"], ROUNDING_OF_QUADRATICS)
        yield between(f"P1, {name}", DISPLACEMENT, 0.0, errors["P1"], LINEAR_ON_QUADRATIC)


def hanging_bar() -> Iterator[Row]:
    """u = (rho g / 2E) (-2 nu x z, -2 nu y z, z^2 + nu (x^2 + y^2)) under the weight -rho g: the only stress is rho g z."""

    def hung(material: Material, gravity: float) -> Field:
        nu, factor = material.poisson_ratio, material.density * gravity / (2 * material.youngs_modulus)

        def displacement(points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3"]:
            x, y, z = points.T
            return factor * np.stack([-2 * nu * x * z, -2 * nu * y * z, z**2 + nu * (x**2 + y**2)], axis=1)

        return displacement

    for name, scale, material in (SOFT, STEEL):
        mesh, exact, weight = jittered_box(scale), hung(material, 9.81), Gravity((0.0, 0.0, -9.81))
        errors = {element: boundary_value_error(mesh, material, element, exact, weight) for element in ("P1", "P2")}
        yield absolute(f"P2, {name}", DISPLACEMENT, 0.0, errors["P2"], ROUNDING_OF_QUADRATICS)
        yield between(f"P1, {name}", DISPLACEMENT, 0.0, errors["P1"], LINEAR_ON_QUADRATIC)


def hydrostatic() -> Iterator[Row]:
    """u = -p x / (3 K) under a pressure on every face, with rollers on three of them; also where the volume hardly changes."""
    for scale, material in ((1.0, Material(3e4, 0.4, 2.0)), (0.02, Material(2e6, 0.499, 1e3))):
        mesh, pressure = jittered_box(scale), 1e-3 * material.youngs_modulus
        for element in ELEMENTS:
            nodes = finite_elements(mesh, element).nodes
            found = _settled(mesh, material, element, {"rollers": FixedComponents(nodes == 0.0), "water": Traction(pressure=pressure)})
            exact = -pressure / (3 * material.bulk_modulus) * nodes
            yield absolute(f"{element}, nu = {material.poisson_ratio:g}", DISPLACEMENT, 0.0, deviation(found, exact), ROUNDING_OF_PRESSURE)


def _pulled(mesh: TetMesh, material: Material, element: str, gradient: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "nodes 3"]:
    """The answer to the tractions sigma n of a displacement gradient on the six sides of a box from the origin, three corners held 3-2-1."""
    strain = (gradient + gradient.T) / 2
    stress = material.lame_lambda * np.trace(strain) * np.eye(3) + 2 * material.lame_mu * strain
    nodes = finite_elements(mesh, element).nodes
    length, width, height = nodes.max(axis=0)
    effects: dict[str, Effect] = {}
    for axis, name in enumerate("xyz"):
        x, y, z = stress[:, axis].tolist()
        normal = tuple(np.eye(3)[axis].tolist())
        effects[f"{name} start"] = Traction(HalfSpace(normal=normal), (-x, -y, -z))
        effects[f"{name} end"] = Traction(HalfSpace((length, width, height), tuple((-np.eye(3)[axis]).tolist())), (x, y, z))
    held = np.zeros(nodes.shape, dtype=np.bool_)
    held[(nodes == 0).all(axis=1)] = True
    held[(nodes == [length, 0, 0]).all(axis=1), 1:] = True
    held[(nodes == [0, width, 0]).all(axis=1), 2] = True
    return _settled(mesh, material, element, effects | {"corners": FixedComponents(held)})


def _settled(mesh: TetMesh, material: Material, element: str, effects: dict[str, Effect]) -> Float64[np.ndarray, "nodes 3"]:
    return static_solution(plan(Scene(Geometry(), effects, material, solver=Solver("newmark", element=element)), mesh))
