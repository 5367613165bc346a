"""How large a time step may be, and the quantity that shows when it was too large."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import LinearOperator, eigsh

from sdfnet.physics.elasticity import ElasticModel, shape_gradients
from sdfnet.physics.mass import ConsistentMass, LumpedMass, Mass

LANCZOS_TOLERANCE = 1e-9  # relative, on omega_max^2, which Lanczos approaches from below
DENSE_SIZE = 30  # below so many unknowns Lanczos has no room and the dense solver is instant


@dataclass(frozen=True)
class StepLimits:
    """The largest stable step of symplectic Euler, h = 2 / omega_max, from six sources; all in s, constraints counted.

    `courant` is the paper's h_min / c. It is no bound: on the bunny it is two to four times the truth.
    """

    lumped: float  # the truth for the lumped mass
    consistent: float  # the truth for the consistent mass
    gershgorin: float  # lumped; never above the truth
    element_lumped: float  # never above the truth
    element_consistent: float  # never above the truth
    courant: float  # the paper's

    def of(self, mass: str) -> float:
        """The true limit of the mass that `solver.mass` names, s."""
        return self.lumped if mass == "lumped" else self.consistent

    def lines(self) -> list[str]:
        """A table of all six for the screen."""
        rows = (
            ("true limit 2/omega_max, lumped mass", self.lumped, self.lumped),
            ("true limit 2/omega_max, consistent mass", self.consistent, self.consistent),
            ("Gershgorin bound, lumped mass", self.gershgorin, self.lumped),
            ("element bound, lumped mass", self.element_lumped, self.lumped),
            ("element bound, consistent mass", self.element_consistent, self.consistent),
            ("the paper's CFL h_min/c, lumped mass", self.courant, self.lumped),
            ("the paper's CFL h_min/c, consistent mass", self.courant, self.consistent),
        )
        verdicts = ("" if step <= truth else "  NOT SAFE" for _, step, truth in rows)
        return [f"{name:<42}{step:>11.3e} s{step / truth:>7.2f} of the truth{verdict}" for (name, step, truth), verdict in zip(rows, verdicts, strict=True)]


def step_limits(model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> StepLimits:
    """All limits of an elastic model whose `fixed` components are held.

    Gershgorin: omega_max^2 <= largest absolute row sum of M^-1/2 K M^-1/2. Element bound (linear tets): omega_max^2 <=
    largest over the tets of (4 / rho) lambda_max(B^T C B); five times that for the consistent mass, because B sees
    nothing of a translation and an element's consistent mass is a fifth of the lumped one on all else.
    """
    free = np.flatnonzero(~fixed.ravel())
    stiffness = model.stiffness[free][:, free]
    inverse_root = diags(1 / np.sqrt(LumpedMass(model, fixed).diagonal))
    scaled = csr_matrix(inverse_root @ stiffness @ inverse_root)
    element = _largest_element_eigenvalue(model)
    return StepLimits(
        lumped=2 / math.sqrt(_largest_eigenvalue(scaled, None)),
        consistent=2 / math.sqrt(_largest_eigenvalue(stiffness, ConsistentMass(model, fixed))),
        gershgorin=2 / math.sqrt(float(abs(scaled).sum(axis=1).max())),
        element_lumped=2 / math.sqrt(element),
        element_consistent=2 / math.sqrt(5 * element),
        courant=model.mesh.smallest_edge / model.material.pressure_wave_speed,
    )


def _largest_eigenvalue(matrix: csr_matrix, mass: ConsistentMass | None) -> float:
    """lambda_max of A x = lambda M x, with M = 1 for None."""
    size = matrix.shape[0]
    start = np.random.default_rng(0).standard_normal(size)  # fixed, so that the step does not change from run to run
    if mass is None:
        if size < DENSE_SIZE:
            return float(np.linalg.eigvalsh(matrix.toarray())[-1])
        return float(eigsh(matrix, k=1, which="LA", v0=start, tol=LANCZOS_TOLERANCE, return_eigenvectors=False)[0])
    if size < DENSE_SIZE:
        return float(np.linalg.eigvals(mass.solve(matrix.toarray())).real.max())
    product = LinearOperator((size, size), matvec=lambda x: mass.product(x.reshape(-1, 1)).ravel(), dtype=np.float64)
    inverse = LinearOperator((size, size), matvec=lambda x: mass.solve(x.reshape(-1, 1)).ravel(), dtype=np.float64)
    return float(eigsh(matrix, k=1, M=product, Minv=inverse, which="LA", v0=start, tol=LANCZOS_TOLERANCE, return_eigenvectors=False)[0])


def _largest_element_eigenvalue(model: ElasticModel) -> float:
    """The largest (4 / rho) lambda_max(B^T C B) over the tets, 1/s^2."""
    material, gradients = model.material, shape_gradients(model.mesh)
    blocks = (
        material.lame_lambda * np.einsum("tia,tjb->tiajb", gradients, gradients)
        + material.lame_mu * np.einsum("tib,tja->tiajb", gradients, gradients)
        + material.lame_mu * np.einsum("tic,tjc,ab->tiajb", gradients, gradients, np.eye(3))
    )
    return float(4 / material.density * np.linalg.eigvalsh(blocks.reshape(-1, 12, 12))[:, -1].max())


class EnergyWatch:
    """Watches H = 1/2 v'Mv + 1/2 u'Ku - f'u - (h/2) v'(Ku - f), which symplectic Euler keeps under a constant load.

    The plain energy swings by h omega; H stays to rounding (1e-14 over 1e4 steps). A step over the limit makes its
    terms grow without bound until their rounding shows, within tens of steps. Not for a load that changes with time
    or for damping: H then changes by the work they do.
    """

    def __init__(self, stiffness: csr_matrix, mass: Mass, force: Float64[np.ndarray, "dofs columns"], time_step: float) -> None:
        self._stiffness, self._mass, self._force, self._time_step = stiffness, mass, force, time_step
        self._first: Float64[np.ndarray, " columns"] | None = None
        self._work = np.zeros(force.shape[1])

    def drift(self, displacement: Float64[np.ndarray, "dofs columns"], velocity: Float64[np.ndarray, "dofs columns"]) -> float:
        """|H - H_first| over the largest work |f'u| so far plus |H_first|, the worst column; 0 at the first call, NaN for what is not finite."""
        unbalanced = self._stiffness @ displacement - self._force
        work = (self._force * displacement).sum(axis=0)
        energy = (0.5 * velocity * (self._mass.product(velocity) - self._time_step * unbalanced)).sum(axis=0)
        energy += 0.5 * (displacement * (unbalanced - self._force)).sum(axis=0)
        if self._first is None:
            self._first = energy
        self._work = np.maximum(self._work, np.abs(work))
        scale = self._work + np.abs(self._first)
        change = np.abs(energy - self._first)
        return float(np.max(np.divide(change, scale, out=np.where(change != 0, np.inf, 0.0), where=scale != 0)))
