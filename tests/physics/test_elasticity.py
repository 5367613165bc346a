"""Matrices and loads against what linear elasticity gives in closed form (the reference cases of NUMERICS)."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.sparse import csr_matrix, diags, kron
from scipy.sparse.linalg import cg, eigsh, spsolve

from sdfnet.errors import GeometryError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import ElasticModel, assemble, body_force, finite_elements, shape_gradients, stress_load
from sdfnet.physics.loads import traction_on_patch
from sdfnet.scene import SOLVER_CHOICES, Material

MakeBox = Callable[..., TetMesh]
ELEMENTS = SOLVER_CHOICES["element"]
MATERIAL_A = Material()
STEEL = Material(youngs_modulus=2.1e11, poisson_ratio=0.29, density=7850.0)


@pytest.fixture(scope="module")
def jittered(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 2, 4), np.linspace(0, 1, 5), np.linspace(-1, 0.5, 4), jitter=0.2)


def inside_error(model: ElasticModel, exact: np.ndarray) -> float:
    """The largest error inside when the boundary is given the exact displacement, relative to the largest displacement."""
    outer = np.repeat(model.elements.is_on_boundary, 3)
    inner, outer = np.flatnonzero(~outer), np.flatnonzero(outer)
    assert len(inner) > 0
    wanted = exact.ravel()
    found = spsolve(model.stiffness[inner][:, inner].tocsc(), -model.stiffness[inner][:, outer] @ wanted[outer])
    return float(np.abs(found - wanted[inner]).max() / np.abs(wanted).max())


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("material", [MATERIAL_A, STEEL])
def test_a_linear_displacement_on_the_boundary_is_linear_inside(jittered: TetMesh, material: Material, element: str) -> None:
    strain = np.array([[0.3, -0.2, 0.1], [0.4, 0.1, 0.7], [-0.5, 0.2, -0.4]])
    model = assemble(jittered, material, element)
    assert inside_error(model, model.elements.nodes @ strain.T) < 1e-12  # rounding: the space holds linear functions


@pytest.mark.parametrize(("element", "least", "most"), [("P2", 0.0, 1e-10), ("P1", 5e-3, 2e-2), ("P1_nodal_pressure", 5e-3, 2e-2)])
def test_pure_bending_is_exact_with_quadratic_elements_and_a_percent_off_with_linear_ones(make_box: MakeBox, element: str, least: float, most: float) -> None:
    axis = np.linspace(0, 1, 4)
    model = assemble(make_box(axis, axis, axis, jitter=0.2), MATERIAL_A, element)
    x, y, z = model.elements.nodes.T
    nu = MATERIAL_A.poisson_ratio
    assert least <= inside_error(model, np.stack([x * z, -nu * y * z, -0.5 * (x**2 + nu * (z**2 - y**2))], axis=1)) < most


@pytest.mark.parametrize("element", ELEMENTS)
def test_rigid_motion_causes_no_force(jittered: TetMesh, element: str) -> None:
    model = assemble(jittered, STEEL, element)
    stiffness, nodes = model.stiffness, model.elements.nodes
    size = abs(stiffness).sum(axis=1).max()
    axes = np.eye(3)
    motions = [np.broadcast_to(axis, nodes.shape) for axis in axes] + [np.cross(axis, nodes) for axis in axes]
    for motion in motions:
        u = np.ravel(motion)
        assert np.abs(stiffness @ u).max() <= 1e-14 * size * np.abs(u).max()  # rounding of one row's sum
        assert abs(u @ stiffness @ u) <= 1e-12 * size * (u @ u)


@pytest.mark.parametrize("element", ELEMENTS)
def test_only_rigid_motions_cause_no_force(make_box: MakeBox, element: str) -> None:
    mesh = make_box([0, 1, 2], [0, 0.5, 1], [-1, 0, 0.5], jitter=0.2)
    eigenvalues = np.linalg.eigvalsh(assemble(mesh, MATERIAL_A, element).stiffness.toarray())
    assert np.sum(np.abs(eigenvalues) < 1e-10 * eigenvalues[-1]) == 6
    assert eigenvalues[6] > 1e-4 * eigenvalues[-1]


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("material", [MATERIAL_A, STEEL])
def test_both_masses_sum_to_density_times_volume(jittered: TetMesh, material: Material, element: str) -> None:
    model = assemble(jittered, material, element)
    mass = material.density * 2 * 1 * 1.5
    assert model.lumped_mass.sum() == pytest.approx(mass, rel=1e-13)
    assert model.consistent_mass.sum() == pytest.approx(mass, rel=1e-13)
    assert model.lumped_mass.min() > 0


@pytest.mark.parametrize("element", ELEMENTS)
def test_consistent_mass_integrates_products_of_linear_functions_exactly(jittered: TetMesh, element: str) -> None:
    model = assemble(jittered, STEEL, element)
    x, _, z = model.elements.nodes.T
    exact = STEEL.density * (2**2 / 2) * (0.5**2 / 2 - 1 / 2)  # rho * integral of x over [0, 2], 1 over [0, 1], z over [-1, 0.5]
    assert x @ model.consistent_mass @ z == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("poisson_ratio", [0.4, 0.499])
def test_pressure_on_every_face_shrinks_the_solid_evenly(jittered: TetMesh, poisson_ratio: float, element: str) -> None:
    material = Material(youngs_modulus=3e4, poisson_ratio=poisson_ratio, density=2.0)
    bulk_modulus = material.youngs_modulus / (3 * (1 - 2 * poisson_ratio))
    pressure = 120.0
    model = assemble(jittered, material, element)
    patch = traction_on_patch(model.elements, pressure, lambda points: np.ones(len(points), dtype=np.bool_))
    exact = -pressure / (3 * bulk_modulus) * model.elements.nodes
    inner_force = (model.stiffness @ exact.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(inner_force, patch.nodal_force, rtol=0, atol=1e-10 * np.abs(patch.nodal_force).max())
    assert patch.area == pytest.approx(2 * (2 * 1 + 2 * 1.5 + 1 * 1.5), rel=1e-12)
    np.testing.assert_allclose(patch.resultant, 0, atol=1e-10 * pressure * patch.area)


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_body_force_sums_to_density_times_volume_about_the_centre(jittered: TetMesh, element: str) -> None:
    density, elements = np.array([1.0, -2.0, 3.0]), finite_elements(jittered, element)
    nodal_force = body_force(elements, density)
    np.testing.assert_allclose(nodal_force.sum(axis=0), density * 3.0, rtol=1e-12)
    np.testing.assert_allclose(np.cross(elements.nodes, nodal_force).sum(axis=0), np.cross([1.0, 0.5, -0.25], density * 3.0), rtol=1e-12)


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_body_force_that_varies_does_the_work_of_its_integral(jittered: TetMesh, element: str) -> None:
    elements = finite_elements(jittered, element)
    nodal_force = body_force(elements, lambda points: points[:, [2, 2, 0]] * [1.0, 0.0, 2.0])
    work = (nodal_force * elements.nodes[:, [2, 0, 0]]).sum()
    exact = (0.5**3 + 1) / 3 * 2 + 2 * 2**3 / 3 * 1.5  # integrals of z^2 and of 2 x^2 over [0, 2] x [0, 1] x [-1, 0.5]
    assert work == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_stress_pushes_as_the_strain_that_would_cause_it(jittered: TetMesh, element: str) -> None:
    model = assemble(jittered, MATERIAL_A, element)
    strain = np.array([[0.1, 0.3, -0.2], [0.3, -0.4, 0.2], [-0.2, 0.2, 0.5]])
    stress = MATERIAL_A.lame_lambda * np.trace(strain) * np.eye(3) + 2 * MATERIAL_A.lame_mu * strain
    inner_force = (model.stiffness @ (model.elements.nodes @ strain).ravel()).reshape(-1, 3)
    np.testing.assert_allclose(stress_load(model.elements, stress), inner_force, rtol=0, atol=1e-12 * np.abs(inner_force).max())


def test_shape_gradients_differentiate_linear_functions(jittered: TetMesh) -> None:
    gradients = np.einsum("tia,tib->tab", jittered.nodes[jittered.tets], shape_gradients(jittered))
    np.testing.assert_allclose(gradients, np.broadcast_to(np.eye(3), gradients.shape), atol=1e-12)


@pytest.mark.parametrize(("material", "length"), [(MATERIAL_A, 1.0), (STEEL, 0.3)])
def test_a_bar_between_rollers_rings_at_the_pressure_wave_frequency(make_box: MakeBox, material: Material, length: float) -> None:
    width = length / 40
    mesh = make_box(np.linspace(0, length, 41), [0, width], [0, width])
    model = assemble(mesh, material)
    free = 3 * np.flatnonzero(mesh.nodes[:, 0] > 0)  # x components behind the wall; rollers hold all y and z
    mass = csr_matrix(kron(model.consistent_mass, np.eye(3)))
    smallest = eigsh(model.stiffness[free][:, free], k=1, M=mass[free][:, free], sigma=0, return_eigenvectors=False)[0]
    exact = math.pi * material.pressure_wave_speed / (2 * length)
    assert math.sqrt(smallest) == pytest.approx(exact, rel=0.005)  # NUMERICS, P1 with 40 elements


def test_a_disc_of_pressure_sinks_into_a_half_space_as_in_theory(make_box: MakeBox) -> None:
    """A quarter of the problem; elements of a fifth of the radius under the disc, growing outward to 39 radii, where the solid is held."""
    radius, pressure, material = 0.01, 30.0, Material(youngs_modulus=8e3, poisson_ratio=0.3, density=1.0)
    spacing = 0.2 * radius * np.concatenate([np.ones(6), 1.45 ** np.arange(1, 12)])
    axis = np.concatenate([[0.0], np.cumsum(spacing)])
    mesh = make_box(axis, axis, -axis[::-1])
    patch = traction_on_patch(
        finite_elements(mesh),
        pressure,
        lambda points: (np.linalg.norm(points[:, :2], axis=1) <= radius) & (points[:, 2] > -1e-9),
        np.array([0.0, 0.0, -1.0]),
        (mesh.nodes[mesh.boundary_faces][:, :, 2] == 0).all(axis=1),
    )
    held = np.zeros((len(mesh.nodes), 3), dtype=np.bool_)
    held[mesh.nodes[:, 0] == 0, 0] = True
    held[mesh.nodes[:, 1] == 0, 1] = True
    held[(mesh.nodes[:, 2] == -axis[-1]) | (mesh.nodes[:, :2] == axis[-1]).any(axis=1)] = True
    free = np.flatnonzero(~held.ravel())
    displacement = np.zeros(held.size)
    stiffness = assemble(mesh, material).stiffness
    inner = stiffness[free][:, free]
    displacement[free], failed = cg(inner, patch.nodal_force.ravel()[free], rtol=1e-8, M=diags(1 / inner.diagonal()))
    middle = np.flatnonzero((mesh.nodes == 0).all(axis=1))[0]
    assert failed == 0
    meshed_radius = math.sqrt(4 * patch.area / math.pi)
    exact = 2 * (1 - material.poisson_ratio**2) * pressure * meshed_radius / material.youngs_modulus
    assert meshed_radius == pytest.approx(radius, rel=0.01)
    assert -displacement[3 * middle + 2] == pytest.approx(exact, rel=0.08)  # NUMERICS, P1 with 5 elements per radius


def test_a_node_without_a_tet_is_named() -> None:
    mesh = TetMesh(np.array([[0.0, 0, 0], [9, 9, 9], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 2, 3, 4]]))
    with pytest.raises(GeometryError, match="found 1 that do not, the first at index 1; remove them"):
        assemble(mesh, MATERIAL_A)
