"""Elasticity for large deformations: a solid that bends, turns and stretches far."""

from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.sparse import coo_matrix, csr_matrix
from torch import Tensor

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.roles import ForceLaw, ReplacesElasticity, Report
from sdfnet.physics.elasticity import ElasticModel, shape_gradients
from sdfnet.physics.integrators.integrator import torch_csr
from sdfnet.physics.materials import per_tet
from sdfnet.scene import Material

# A wave's speed squared along n is (mu + (lambda + mu) |cof F n|^2) / rho: frequencies grow no faster than the area of faces. So this allows
# faces 1.4 times their area: a bar under tension to twice its length or pressed to half, a shear by 0.9, a swelling of each length by 0.15.
STABLE_FRACTION = 0.7
CYCLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


@dataclass(frozen=True)
class FiniteStrain(ReplacesElasticity):
    """P = dW/dF in Pa with W = mu/2 (I_C - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2 in J/m^3: a neo-Hookean solid.

    F = 1 + grad u, I_C = F : F, J = det F, and so P = mu F + ((lambda + mu)(J - 1) - mu) cof F. W has no logarithm and
    is finite also where a tet is turned inside out (a member of the family of Smith, de Goes and Kim 2018). At rest
    P = 0 and dP = mu dF + (lambda + mu) tr(dF) 1 - mu (tr(dF) 1 - dF^T) = lambda tr(dF) 1 + mu (dF + dF^T): linear
    elasticity with the same lambda and mu. A rotation causes no force.

    For strains over a tenth and for rotations, which linear elasticity takes for strains. Not for less: there it gives
    the same and costs more. Not for strong compression of a solid that changes its volume easily: pressed along one axis
    to mu / (lambda + 2 mu) of its length (1/6 at nu = 0.4, 1/2 at nu = 0) it collapses sideways. A tet that is turned
    inside out is pushed back, but what it goes through means nothing. Linear tets only.
    """

    def elastic_law(self, model: ElasticModel) -> ForceLaw:
        """The elastic force. Raises ConfigurationError for other elements than P1."""
        if model.elements.element != "P1":
            raise ConfigurationError(f"finite strain needs linear tets, found solver.element={model.elements.element}; set solver.element=P1")
        return NeoHooke(model)


@final
class NeoHooke(ForceLaw):
    """The nodal force of `FiniteStrain`, from edges and volumes.

    With V cof F grad N = dv/dx, where v is a tet's volume now and V at rest, the force on a node is
    -mu (L u + b) - sum over its tets of ((lambda + mu)(v/V - 1) - mu) dv/dx. L = integral of grad N . grad N and
    b = integral of grad N do not change; dv/dx of corners 1, 2, 3 are the cross products of the two other edges from
    corner 0, over 6, and corner 0 has minus their sum.
    """

    stable_fraction = STABLE_FRACTION

    def __init__(self, model: ElasticModel) -> None:
        mesh, material = model.mesh, model.material
        n_tets, n_nodes = len(mesh.tets), len(mesh.nodes)
        self._tets, self._gradients, self._volumes = mesh.tets, shape_gradients(mesh), mesh.volumes
        self._mu, self._stiffening = (np.asarray(number) for number in (material.lame_mu, material.lame_lambda + material.lame_mu))
        self._shear, self._minus_stiffening = torch.as_tensor(self._mu), torch.as_tensor(-self._stiffening)
        self._laplacian, self._collect = torch_csr(_negative_weighted_laplacian(model)), torch_csr(_collection(mesh.tets, n_nodes))
        self._positions, self._corners = torch.from_numpy(mesh.nodes), torch.from_numpy(mesh.tets.T.astype(np.int32).ravel())
        # Tets last: arithmetic on whole arrays of one number per tet is several times faster than on small matrices.
        self._places, self._edges, self._normals = (torch.empty(3, count, n_tets, dtype=torch.float64) for count in (4, 3, 3))
        self._sixfold, self._strength = (torch.empty(n_tets, dtype=torch.float64) for _ in range(2))
        self._volumetric = torch.empty(3, n_nodes, dtype=torch.float64)
        self._deform(self._positions)
        self._rest_sixfold = self._sixfold.clone()
        self._offset = -self._volumetric_force().T.contiguous()  # -mu b, found by the same sums, so that of the force at rest nothing at all remains

    def force(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> Float64[Tensor, "nodes 3"]:
        """-integral of P : grad N, N."""
        self._deform(self._positions + displacement)
        return torch.addmm(self._offset, self._laplacian, displacement).add_(self._volumetric_force().T)

    def stored_energy(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> float:
        """The integral of W, J."""
        gradient, growth, cofactors = self._invariants(displacement.numpy())
        density = self._mu * (0.5 * (gradient**2).sum(axis=(1, 2)) - cofactors) + 0.5 * self._stiffening * growth**2
        return float(self._volumes @ density)

    def added_stiffness(self) -> Float64[np.ndarray, " nodes"]:
        """None: at rest it is the linear stiffness."""
        return np.zeros(len(self._positions))

    def report(self, displacement: Float64[np.ndarray, "frames nodes 3"], times: Float64[np.ndarray, " frames"]) -> Report:
        """How far the tets were compressed and blown up over the recorded frames: v/V, negative where one is inverted."""
        ratios = [1 + self._invariants(frame)[1] for frame in displacement]
        return {"smallest_volume_ratio": float(min(map(np.min, ratios))), "largest_volume_ratio": float(max(map(np.max, ratios)))}

    def _deform(self, positions: Float64[Tensor, "nodes 3"]) -> None:
        """Of every tet: the edges from corner 0, their cross products, which are sixfold dv/dx of corners 1 to 3, and the sixfold volume."""
        for coordinate, places in zip(positions.T.contiguous(), self._places, strict=True):
            torch.index_select(coordinate, 0, self._corners, out=places.view(-1))
        edges, normals = torch.sub(self._places[:, 1:], self._places[:, :1], out=self._edges), self._normals
        for x, y, z in CYCLES:  # components
            for corner, following, last in CYCLES:
                torch.mul(edges[y, following], edges[z, last], out=normals[x, corner])
                normals[x, corner].addcmul_(edges[z, following], edges[y, last], value=-1)
        torch.mul(edges[0, 0], normals[0, 0], out=self._sixfold)
        self._sixfold.addcmul_(edges[1, 0], normals[1, 0]).addcmul_(edges[2, 0], normals[2, 0])

    def _volumetric_force(self) -> Float64[Tensor, "3 nodes"]:
        """-sum over tets of ((lambda + mu)(v/V - 1) - mu) dv/dx, N, after `_deform`, whose cross products it uses up."""
        torch.div(self._sixfold, self._rest_sixfold, out=self._strength).sub_(1).mul_(self._minus_stiffening).add_(self._shear)
        for normals, force in zip(self._normals.mul_(self._strength), self._volumetric, strict=True):
            torch.mv(self._collect, normals.view(-1), out=force)
        return self._volumetric

    def _invariants(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """H = grad u, J - 1, and J - 1 - tr H of every tet, without the cancellation of going by J.

        W = mu (1/2 H : H - (J - 1 - tr H)) + (lambda + mu)/2 (J - 1)^2.
        """
        gradient = displacement[self._tets].transpose(0, 2, 1) @ self._gradients
        trace = np.trace(gradient, axis1=1, axis2=2)
        cofactors = 0.5 * (trace**2 - (gradient * gradient.transpose(0, 2, 1)).sum(axis=(1, 2))) + np.linalg.det(gradient)
        return gradient, trace + cofactors, cofactors


def _negative_weighted_laplacian(model: ElasticModel) -> csr_matrix:
    """-mu L, L the integral of grad N . grad N, N/m; with several materials mu stands within the integral."""
    tets, gradients, material = model.mesh.tets, shape_gradients(model.mesh), model.material
    within, before = (1.0, material.lame_mu) if isinstance(material, Material) else (per_tet(material.lame_mu, 2), 1.0)
    blocks = within * model.mesh.volumes[:, None, None] * (gradients @ gradients.transpose(0, 2, 1))
    places = (np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, 4).ravel())
    return csr_matrix(-before * csr_matrix(coo_matrix((blocks.ravel(), places))))


def _collection(tets: Int64[np.ndarray, "tets 4"], n_nodes: int) -> csr_matrix:
    """Adds up a sixth of what corners 1 to 3 of all tets have, one corner after the other, at the nodes, and takes it from corner 0."""
    n_tets = len(tets)
    rows, columns = np.concatenate([tets[:, 1:].T.ravel(), np.tile(tets[:, 0], 3)]), np.tile(np.arange(3 * n_tets), 2)
    return csr_matrix((np.repeat([1 / 6, -1 / 6], 3 * n_tets), (rows, columns)), shape=(n_nodes, 3 * n_tets))
