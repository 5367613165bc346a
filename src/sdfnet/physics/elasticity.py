"""Mass, stiffness and loads of linear elasticity on a tet mesh (paper section 2): the only module that imports scikit-fem."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_matrix, csr_matrix, diags
from skfem import Basis, BilinearForm, Element, ElementTetP1, ElementTetP2, ElementVector, LinearForm, MeshTet
from skfem.helpers import ddot, dot, grad
from skfem.models.elasticity import linear_elasticity
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTri

from sdfnet.errors import ConfigurationError, GeometryError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elements import MIDDLE_ENDS, FiniteElements
from sdfnet.physics.materials import Materials, per_tet
from sdfnet.scene import Material

Field = Callable[[Float64[np.ndarray, "points 3"]], Float64[np.ndarray, "points 3"]]

CORNER_SHARE, MIDDLE_SHARE = 1 / 36, 4 / 27  # of a quadratic tet's mass (Hinton, Rock and Zienkiewicz): its row sums would be negative at the corners
FIELD_QUADRATURE_ORDER = 6  # for fields that are no polynomials: a load that is smooth on the scale of a tet errs by far less than the elements do


@dataclass(frozen=True, eq=False)
class ElasticModel:
    """The matrices of the paper's weak form, before any constraint. Every component has the same scalar mass matrix."""

    elements: FiniteElements
    material: Materials  # of the whole solid, or of every tet
    stiffness: csr_matrix  # (3 nodes, 3 nodes) N/m: integral of sigma(u) : epsilon(v)
    consistent_mass: csr_matrix  # (nodes, nodes) kg: integral of rho u v for one component, the paper's
    lumped_mass: Float64[np.ndarray, " nodes"]  # kg: P1 its row sums, P2 each tet's by HRZ
    weight_mass: str = "lumped"  # which of the two weighs: consistent where the solid is held, else the one that moves

    @property
    def mesh(self) -> TetMesh:
        """The tet mesh at rest."""
        return self.elements.mesh

    @property
    def nodal_mass(self) -> Float64[np.ndarray, " nodes"]:
        """What an acceleration of 1 m/s^2 along one component takes at each node, kg: M 1, with M the mass that weighs.

        For a load in proportion to the mass. The sum is rho V; of linear tets it is the same for both masses, to rounding.
        """
        return self.lumped_mass if self.weight_mass == "lumped" else np.asarray(self.consistent_mass.sum(axis=1)).ravel()


def finite_elements(mesh: TetMesh, element: str = "P1") -> FiniteElements:
    """The nodes of a displacement: P1 linear, P1_nodal_pressure linear with the pressure averaged over nodes, P2 quadratic."""
    if element != "P2":
        return FiniteElements(mesh, element, mesh.nodes, mesh.tets)
    tets = Basis(_skfem(mesh), ElementTetP2()).element_dofs.T.astype(np.int64)
    nodes = np.empty((tets.max() + 1, 3))
    nodes[: len(mesh.nodes)] = mesh.nodes
    for local, ends in enumerate(MIDDLE_ENDS, start=4):  # not scikit-fem's places: those are off by rounding, and a plane would miss them
        nodes[tets[:, local]] = mesh.nodes[mesh.tets[:, ends]].mean(axis=1)
    return FiniteElements(mesh, element, nodes, tets)


def assemble(mesh: TetMesh, material: Materials, element: str = "P1", weight_mass: str = "lumped") -> ElasticModel:
    """Stiffness and both masses of the solid, in float64; `weight_mass` names the one that weighs.

    sigma(u) = lambda div(u) I + 2 mu epsilon(u). Linear tets lock when the material hardly changes its volume (Poisson
    ratio over 0.45) and are stiff in bending; P1_nodal_pressure cures the first, P2 both. Raises GeometryError when a
    node belongs to no tet: it would have no mass; ConfigurationError for P1_nodal_pressure with several materials.
    """
    lonely = np.setdiff1d(np.arange(len(mesh.nodes)), mesh.tets)
    if len(lonely):
        raise GeometryError(f"every node must belong to a tet, found {len(lonely)} that do not, the first at index {lonely[0]}; remove them")
    elements = finite_elements(mesh, element)
    scalar = _element(elements)
    if element == "P1_nodal_pressure":
        if not isinstance(material, Material):
            raise ConfigurationError("P1_nodal_pressure would average the pressure of unlike materials where they meet; set solver.element=P1 or P2")
        stiffness = _stiffness(mesh, scalar, -2 * material.lame_mu / 3, material.lame_mu) + _pressure_stiffness(mesh, material)
    else:
        stiffness = _stiffness(mesh, scalar, material.lame_lambda, material.lame_mu)
    consistent_mass = csr_matrix(BilinearForm(lambda u, v, _: per_tet(material.density, 1) * u * v).assemble(Basis(_skfem(mesh), scalar)))
    lumped_mass = np.bincount(elements.tets.ravel(), lumped_mass_shares(elements, material.density).ravel())
    return ElasticModel(elements, material, csr_matrix(stiffness), consistent_mass, lumped_mass, weight_mass)


def body_force(elements: FiniteElements, density: Float64[np.ndarray, "*tets 3"] | Field) -> Float64[np.ndarray, "nodes 3"]:
    """Nodal force (N) of a force density (N/m^3), constant, one for each tet, or a function of the rest position: the integral of f v."""
    if isinstance(density, np.ndarray):
        components = np.atleast_2d(density).T[:, :, None]
        return _assembled(elements, LinearForm(lambda v, _: dot(components, v)))
    return _assembled(elements, LinearForm(lambda v, w: dot(_at(density, w.x), v)), FIELD_QUADRATURE_ORDER)


def stress_load(elements: FiniteElements, stress: Float64[np.ndarray, "*tets 3 3"]) -> Float64[np.ndarray, "nodes 3"]:
    """Nodal force (N) that a stress (Pa), the same everywhere or one for each tet, exerts by itself: the integral of sigma : grad v."""
    components = np.moveaxis(np.reshape(stress, (-1, 3, 3)), 0, 2)[..., None]
    return _assembled(elements, LinearForm(lambda v, _: ddot(components, grad(v))))


def shape_gradients(mesh: TetMesh) -> Float64[np.ndarray, "tets 4 3"]:
    """Gradient of each corner's linear shape function in each tet, 1/m; constant in a tet."""
    corners = mesh.nodes[mesh.tets]
    last_three = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    return np.concatenate([-last_three.sum(axis=1, keepdims=True), last_three], axis=1)


def displacement_gradients(mesh: TetMesh, displacements: Float64[np.ndarray, "frames nodes 3"]) -> Iterator[Float64[np.ndarray, "tets 3 3"]]:
    """grad u of every tet (entry a, b is du_a / dx_b), one frame after the other; of linear tets, for others between the corners."""
    gradients = shape_gradients(mesh)
    for displacement in displacements:
        yield np.einsum("tia,tib->tab", displacement[mesh.tets], gradients)


def element_matrices(model: ElasticModel) -> tuple[Float64[np.ndarray, "tets dofs dofs"], Float64[np.ndarray, "tets dofs dofs"]]:
    """Stiffness (N/m) and consistent mass (kg) of each tet by itself; for P1_nodal_pressure the plain P1 stiffness, which is no smaller."""
    material, scalar = model.material, _element(model.elements)
    basis = Basis(_skfem(model.mesh), ElementVector(scalar))
    stiffness = linear_elasticity(per_tet(material.lame_lambda, 1), per_tet(material.lame_mu, 1)).elemental(basis).tolocal()
    mass = BilinearForm(lambda u, v, _: per_tet(material.density, 1) * dot(u, v)).elemental(basis).tolocal()
    return stiffness, mass


def lumped_mass_shares(elements: FiniteElements, density: float | Float64[np.ndarray, " tets"]) -> Float64[np.ndarray, "tets corners"]:
    """What each tet gives to each of its nodes, kg."""
    shares = np.array(4 * [CORNER_SHARE] + 6 * [MIDDLE_SHARE] if elements.is_quadratic else 4 * [1 / 4])
    result: np.ndarray = per_tet(density, 1) * elements.mesh.volumes[:, None] * shares
    return result


def triangle_quadrature(order: int) -> tuple[Float64[np.ndarray, "2 quadrature"], Float64[np.ndarray, " quadrature"]]:
    """Points and weights on the unit triangle, exact for polynomials up to `order`; at most 19."""
    points, weights = get_quadrature(RefTri, order)
    return points, weights


def _skfem(mesh: TetMesh) -> MeshTet:
    return MeshTet(np.ascontiguousarray(mesh.nodes.T), np.ascontiguousarray(mesh.tets.T))


def _element(elements: FiniteElements) -> Element:
    return ElementTetP2() if elements.is_quadratic else ElementTetP1()


def _stiffness(mesh: TetMesh, scalar: Element, lame_lambda: float | np.ndarray, lame_mu: float | np.ndarray) -> csr_matrix:
    order = 2 * (scalar.maxdeg - 1)  # of a product of two gradients; scikit-fem would integrate as if of two functions, for ten times the time
    return csr_matrix(linear_elasticity(per_tet(lame_lambda, 1), per_tet(lame_mu, 1)).assemble(Basis(_skfem(mesh), ElementVector(scalar), intorder=order)))


def _pressure_stiffness(mesh: TetMesh, material: Material) -> csr_matrix:
    """K_p = kappa D' V D: the volume change averaged over the tets around a node before it is squared (Bonet and Burton 1998).

    D maps a displacement to the nodal volume strain, V is each node's quarter of its tets' volumes, kappa the bulk modulus.
    """
    quarter = np.repeat(mesh.volumes / 4, 4)
    node_volumes = np.bincount(mesh.tets.ravel(), quarter)
    columns = 3 * mesh.tets[:, :, None] + np.arange(3)  # (tets, 4, 3)
    divergence = coo_matrix(
        (shape_gradients(mesh).ravel(), (np.repeat(np.arange(len(mesh.tets)), 12), columns.ravel())), shape=(len(mesh.tets), mesh.nodes.size)
    )
    average = coo_matrix((quarter / node_volumes[mesh.tets.ravel()], (mesh.tets.ravel(), np.repeat(np.arange(len(mesh.tets)), 4)))).tocsr()
    nodal = average @ divergence.tocsr()
    return csr_matrix(nodal.T @ diags(material.bulk_modulus * node_volumes) @ nodal)


def _assembled(elements: FiniteElements, form: LinearForm, order: int | None = None) -> Float64[np.ndarray, "nodes 3"]:
    basis = Basis(_skfem(elements.mesh), ElementVector(_element(elements)), intorder=order)
    vector: np.ndarray = form.assemble(basis).reshape(-1, 3)
    return vector


def _at(field: Field, positions: np.ndarray) -> np.ndarray:
    """A field's values (3, tets, quadrature) at quadrature points of that shape."""
    return field(positions.reshape(3, -1).T).T.reshape(positions.shape)
