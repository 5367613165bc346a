"""Where the nodes of each element are, and what the surface knows of them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import assemble, element_matrices, finite_elements, lumped_mass_shares
from sdfnet.physics.loads import traction_on_patch
from sdfnet.physics.regions import BoxRegion
from sdfnet.scene import SOLVER_CHOICES, Material

MakeBox = Callable[..., TetMesh]
ELEMENTS = SOLVER_CHOICES["element"]
FINE = 0.50  # 0.506 with P2 and 10 cells a side, falling; 0.495 with P1_nodal_pressure and 16, rising


@pytest.fixture(scope="module")
def jittered(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 2, 4), np.linspace(0, 1, 5), np.linspace(-1, 0.5, 4), jitter=0.2)


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_corners_come_first_and_are_those_of_the_mesh(jittered: TetMesh, element: str) -> None:
    elements = finite_elements(jittered, element)
    np.testing.assert_array_equal(elements.nodes[: len(jittered.nodes)], jittered.nodes)
    np.testing.assert_array_equal(elements.tets[:, :4], jittered.tets)
    np.testing.assert_array_equal(elements.boundary_faces[:, :3], jittered.boundary_faces)
    assert elements.is_quadratic == (element == "P2")


def test_every_edge_has_one_node_in_its_middle(jittered: TetMesh) -> None:
    elements = finite_elements(jittered, "P2")
    edges = {tuple(sorted((tet[i], tet[j]))) for tet in jittered.tets.tolist() for i in range(4) for j in range(i)}
    assert len(elements.nodes) == len(jittered.nodes) + len(edges)
    middles = {tuple(np.round(jittered.nodes[list(edge)].mean(axis=0), 12)) for edge in edges}
    assert middles == {tuple(np.round(node, 12)) for node in elements.nodes[len(jittered.nodes) :]}


def test_the_middles_of_a_boundary_face_lie_between_its_corners(jittered: TetMesh) -> None:
    elements = finite_elements(jittered, "P2")
    corners, middles = elements.nodes[elements.boundary_faces[:, :3]], elements.nodes[elements.boundary_faces[:, 3:]]
    np.testing.assert_allclose(middles, (corners + np.roll(corners, -1, axis=1)) / 2, rtol=0, atol=1e-15)  # of edges 01, 12, 20


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_surface_is_shared_out_among_its_nodes_whole(jittered: TetMesh, element: str) -> None:
    elements = finite_elements(jittered, element)
    assert elements.surface_areas.sum() == pytest.approx(2 * (2 * 1 + 2 * 1.5 + 1 * 1.5), rel=1e-13)
    lower, upper = jittered.nodes.min(axis=0), jittered.nodes.max(axis=0)
    on_surface = ((elements.nodes == lower) | (elements.nodes == upper)).any(axis=1)
    np.testing.assert_array_equal(elements.is_on_boundary, on_surface)
    np.testing.assert_array_equal(elements.surface_areas > 0, on_surface)


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_tets_shares_of_the_mass_are_positive_and_sum_to_its_own(jittered: TetMesh, element: str) -> None:
    shares = lumped_mass_shares(finite_elements(jittered, element), 7.0)
    assert shares.min() > 0
    np.testing.assert_allclose(shares.sum(axis=1), 7.0 * jittered.volumes, rtol=1e-14)


def test_quadratic_shares_are_proportional_to_the_diagonal_of_the_consistent_mass(jittered: TetMesh) -> None:
    model = assemble(jittered, Material(density=7.0), "P2")  # Hinton, Rock and Zienkiewicz
    _, mass = element_matrices(model)
    diagonal = np.einsum("tii->ti", mass)[:, ::3]
    expected = diagonal / diagonal.sum(axis=1, keepdims=True) * 7.0 * jittered.volumes[:, None]
    np.testing.assert_allclose(lumped_mass_shares(model.elements, 7.0), expected, rtol=1e-12)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_matrices_of_single_tets_add_up_to_those_of_the_solid(make_box: MakeBox, element: str) -> None:
    model = assemble(make_box([0, 1, 2], [0, 1], [0, 1, 1.5], jitter=0.1), Material(), element)
    stiffness, mass = element_matrices(model)
    rows = (3 * model.elements.tets[:, :, None] + np.arange(3)).reshape(len(stiffness), -1)
    for found, whole in ((stiffness, model.stiffness.toarray()), (mass, np.kron(model.consistent_mass.toarray(), np.eye(3)))):
        total = np.zeros_like(whole)
        np.add.at(total, (rows[:, :, None], rows[:, None, :]), found)
        np.testing.assert_allclose(total, whole, rtol=0, atol=1e-13 * np.abs(whole).max())


def test_averaged_pressure_changes_nothing_for_an_even_strain_and_softens_every_other(jittered: TetMesh) -> None:
    material = Material(poisson_ratio=0.49)
    linear, averaged = (assemble(jittered, material, element).stiffness for element in ("P1", "P1_nodal_pressure"))
    even = (jittered.nodes @ np.array([[0.3, -0.2, 0.1], [0.4, 0.1, 0.7], [-0.5, 0.2, -0.4]])).ravel()
    force = linear @ even
    np.testing.assert_allclose(averaged @ even, force, rtol=0, atol=1e-12 * np.abs(force).max())
    difference = np.linalg.eigvalsh((linear - averaged).toarray())
    assert difference[0] >= -1e-12 * difference[-1]  # an average's square is at most the average of the squares
    assert difference[-1] > 0.1 * abs(linear).max()


def test_near_a_poisson_ratio_of_half_linear_tets_lock_and_the_others_do_not(make_box: MakeBox) -> None:
    """A quarter of a block that is pressed on its middle between slippery walls, in units of p / E."""
    material = Material(poisson_ratio=0.4999)
    assert sinking(make_box, material, "P1", 6) < 0.05 * FINE
    assert sinking(make_box, material, "P1_nodal_pressure", 6) == pytest.approx(FINE, rel=0.1)
    assert sinking(make_box, material, "P2", 4) == pytest.approx(FINE, rel=0.1)
    assert sinking(make_box, replace(material, poisson_ratio=0.3), "P1", 6) == pytest.approx(0.66, rel=0.05)  # the mesh is fine enough


def sinking(make_box: MakeBox, material: Material, element: str, cells: int) -> float:
    axis, pressure = np.linspace(0, 1, cells + 1), 7.0
    model = assemble(make_box(axis, axis, axis), material, element)
    nodes = model.elements.nodes
    top = (model.mesh.nodes[model.mesh.boundary_faces][:, :, 2] == 1).all(axis=1)
    down = np.array([0.0, 0.0, -1.0])
    force = traction_on_patch(model.elements, pressure, BoxRegion(upper=(0.5, 0.5, 1.0)).contains, down, top).nodal_force
    fixed = np.repeat(nodes[:, 2:] == 0, 3, axis=1)
    fixed[:, :2] |= (nodes[:, :2] == 0) | (nodes[:, 2:] == 1)  # planes of symmetry, and a stamp that does not slip
    free = np.flatnonzero(~fixed.ravel())
    displacement = np.zeros(fixed.size)
    displacement[free] = spsolve(model.stiffness[free][:, free].tocsc(), force.ravel()[free])
    middle = np.flatnonzero((nodes == [0, 0, 1]).all(axis=1))[0]
    return float(-displacement[3 * middle + 2] * material.youngs_modulus / pressure)
