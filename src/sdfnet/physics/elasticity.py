"""Mass, stiffness and loads of linear elasticity on a tet mesh (paper section 2): the only module that imports scikit-fem."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csr_matrix
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, MeshTet
from skfem.models.elasticity import linear_elasticity
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTri

from sdfnet.errors import GeometryError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.scene import Material

PATCH_QUADRATURE_ORDER = 19  # the highest that scikit-fem has for triangles, 73 points
PATCH_SPLIT = 4  # parts of a face's edge: with the paper's patch of 3 mm on faces of 5 mm its area errs by 0.2 %, unsplit by 1.6 %
FACES_AT_ONCE = 2048  # bounds the memory for quadrature points to some 100 MB


@dataclass(frozen=True, eq=False)
class ElasticModel:
    """The matrices of the paper's weak form, before any constraint.

    Degree of freedom 3 * node + component. Linear tets (P1): the mass of every component is the same scalar matrix.
    """

    mesh: TetMesh
    material: Material
    stiffness: csr_matrix  # (3 nodes, 3 nodes) N/m: integral of sigma(u) : epsilon(v)
    consistent_mass: csr_matrix  # (nodes, nodes) kg: integral of rho u v for one component, the paper's
    lumped_mass: Float64[np.ndarray, " nodes"]  # kg: its row sums, a quarter of each tet to each corner


@dataclass(frozen=True, eq=False)
class PatchTraction:
    """What a traction on a part of the surface amounts to."""

    nodal_force: Float64[np.ndarray, "nodes 3"]  # N
    area: float  # m^2, really loaded

    @property
    def resultant(self) -> Float64[np.ndarray, "3"]:
        """Sum of the nodal forces, N."""
        total: np.ndarray = self.nodal_force.sum(axis=0)
        return total


def assemble(mesh: TetMesh, material: Material) -> ElasticModel:
    """Stiffness and mass of the solid with linear tets, in float64.

    sigma(u) = lambda div(u) I + 2 mu epsilon(u). Linear tets lock when the material hardly changes its volume (Poisson
    ratio over 0.45) and are stiff in bending. Raises GeometryError when a node belongs to no tet: it would have no mass.
    """
    lonely = np.setdiff1d(np.arange(len(mesh.nodes)), mesh.tets)
    if len(lonely):
        raise GeometryError(f"every node must belong to a tet, found {len(lonely)} that do not, the first at index {lonely[0]}; remove them")
    skfem_mesh = MeshTet(np.ascontiguousarray(mesh.nodes.T), np.ascontiguousarray(mesh.tets.T))
    element = ElementTetP1()
    stiffness = linear_elasticity(material.lame_lambda, material.lame_mu).assemble(Basis(skfem_mesh, ElementVector(element)))
    consistent_mass = BilinearForm(lambda u, v, _: material.density * u * v).assemble(Basis(skfem_mesh, element))
    lumped_mass = np.asarray(consistent_mass.sum(axis=1)).ravel()
    return ElasticModel(mesh, material, csr_matrix(stiffness), csr_matrix(consistent_mass), lumped_mass)


def traction_on_patch(
    mesh: TetMesh,
    pressure: float,
    inside: Callable[[Float64[np.ndarray, "points 3"]], Bool[np.ndarray, " points"]],
    direction: Float64[np.ndarray, "3"] | None = None,
    faces: Bool[np.ndarray, " faces"] | None = None,
) -> PatchTraction:
    """Nodal force of a pressure (Pa) on the part of the surface where `inside` holds: the paper's integral of p H v dS.

    H is integrated at 1,168 quadrature points of every face, so that a patch smaller than a face still has nearly its
    area. The traction points along the unit vector `direction`, or against each face's outward normal when it is None.
    `faces` (a mask over `mesh.boundary_faces`) spares the faces that `inside` cannot reach.
    """
    chosen = mesh.boundary_faces if faces is None else mesh.boundary_faces[faces]
    local, weights = _split_triangle_quadrature()
    shape = np.stack([1 - local[0] - local[1], local[0], local[1]])  # (corners, quadrature)
    nodal_force, area = np.zeros_like(mesh.nodes), 0.0
    for first in range(0, len(chosen), FACES_AT_ONCE):
        block = chosen[first : first + FACES_AT_ONCE]
        corners = mesh.nodes[block]
        points = np.einsum("kq,fkd->fqd", shape, corners)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled_areas = np.linalg.norm(normals, axis=1)
        loaded = inside(points.reshape(-1, 3)).reshape(points.shape[:2]) * weights * doubled_areas[:, None]
        towards = -normals / doubled_areas[:, None] if direction is None else np.broadcast_to(direction, normals.shape)
        np.add.at(nodal_force, block, pressure * (loaded @ shape.T)[:, :, None] * towards[:, None, :])
        area += float(loaded.sum())
    return PatchTraction(nodal_force, area)


def _split_triangle_quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Points (2, quadrature) and weights of the unit triangle cut into PATCH_SPLIT^2 equal ones, half of them turned over."""
    points, weights = get_quadrature(RefTri, PATCH_QUADRATURE_ORDER)
    places = [np.array([[i], [j]]) for i in range(PATCH_SPLIT) for j in range(PATCH_SPLIT - i)]
    parts = [points + place for place in places] + [place + 1 - points for place in places if place.sum() < PATCH_SPLIT - 1]
    return np.concatenate(parts, axis=1) / PATCH_SPLIT, np.tile(weights, len(parts)) / PATCH_SPLIT**2


def body_force(mesh: TetMesh, density: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "nodes 3"]:
    """Nodal force (N) of a constant force density (N/m^3): the integral of f v, a quarter of each tet's to each corner."""
    nodal_force = np.zeros_like(mesh.nodes)
    np.add.at(nodal_force, mesh.tets, (mesh.volumes / 4)[:, None, None] * density)
    return nodal_force


def shape_gradients(mesh: TetMesh) -> Float64[np.ndarray, "tets 4 3"]:
    """Gradient of each corner's shape function in each tet, 1/m; constant in a linear tet."""
    corners = mesh.nodes[mesh.tets]
    last_three = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    return np.concatenate([-last_three.sum(axis=1, keepdims=True), last_three], axis=1)
