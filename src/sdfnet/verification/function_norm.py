"""How far a displacement of finite elements is from a function, in the whole volume and not only at the nodes."""

import math

import numpy as np
from jaxtyping import Float64
from scipy.special import roots_jacobi

from sdfnet.geometry.tetmesh import TET_EDGES
from sdfnet.physics.elasticity import Field
from sdfnet.physics.elements import FiniteElements

POINTS = 4  # along each direction of a tet: exact to degree 7, beyond the 6 of a quadratic displacement's squared error


def relative_l2_error(elements: FiniteElements, displacement: Float64[np.ndarray, "nodes 3"], exact: Field) -> float:
    """||u_h - u|| / ||u|| with ||u||^2 = integral of |u|^2 over the solid."""
    barycentric, weights = _tet_quadrature()
    shape = _quadratic(barycentric) if elements.is_quadratic else barycentric
    corners = elements.mesh.nodes[elements.tets[:, :4]]
    points = np.einsum("qk,tkc->tqc", barycentric, corners)
    found = np.einsum("qk,tkc->tqc", shape, displacement[elements.tets])
    wanted = exact(points.reshape(-1, 3)).reshape(points.shape)

    def squared_norm(values: np.ndarray) -> float:
        return float(np.einsum("t,q,tqc->", elements.mesh.volumes, weights, values**2))

    return math.sqrt(squared_norm(found - wanted) / squared_norm(wanted))


def _quadratic(barycentric: Float64[np.ndarray, "quadrature 4"]) -> Float64[np.ndarray, "quadrature 10"]:
    """The shape functions of a quadratic tet: L (2L - 1) of its corners, then 4 L L of its edges 01, 12, 02, 03, 13, 23 as in `FiniteElements`."""
    edges = TET_EDGES[[0, 3, 1, 2, 4, 5]]
    middles = 4 * barycentric[:, edges[:, 0]] * barycentric[:, edges[:, 1]]
    return np.concatenate([barycentric * (2 * barycentric - 1), middles], axis=1)


def _tet_quadrature() -> tuple[Float64[np.ndarray, "quadrature 4"], Float64[np.ndarray, " quadrature"]]:
    """Barycentric points and weights that sum to 1: Gauss and Jacobi points of a cube collapsed to a tet (Stroud 1971)."""
    rules = [roots_jacobi(POINTS, power, 0) for power in (2, 1, 0)]
    a, b, c = (part.ravel() for part in np.meshgrid(*((points + 1) / 2 for points, _ in rules), indexing="ij"))
    weights = np.einsum("i,j,k->ijk", *(weights for _, weights in rules)).ravel()
    x, y, z = a, b * (1 - a), c * (1 - a) * (1 - b)
    return np.stack([1 - x - y - z, x, y, z], axis=1), weights / weights.sum()
