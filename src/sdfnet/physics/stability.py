"""How large an explicit time step may be."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse import csr_matrix, diags

from sdfnet.physics.effects.roles import Damping
from sdfnet.physics.elasticity import ElasticModel, element_matrices, lumped_mass_shares, shape_gradients
from sdfnet.physics.mass import ConsistentMass, LumpedMass
from sdfnet.physics.materials import per_tet
from sdfnet.physics.modes import largest_eigenvalue
from sdfnet.scene import Material

LUMPED_OVER_CONSISTENT = {False: 5.0, True: 70 / 9}  # the most that a tet's lumped mass can exceed its consistent one, linear and quadratic


@dataclass(frozen=True)
class StepLimits:
    """The largest stable step of leapfrog, h = 2 / omega_max, from six sources; all in s, constraints counted.

    `courant` is the paper's h_min / c. It is no bound: on the bunny it is two to four times the truth. Stiffness that
    effects add (contact) is counted in all but the paper's; damping in `damped`.
    """

    lumped: float  # the truth for the lumped mass
    consistent: float  # the truth for the consistent mass
    gershgorin: float  # lumped; never above the truth
    element_lumped: float  # never above the truth
    element_consistent: float  # never above the truth
    courant: float  # the paper's
    damping: Damping
    stable_fraction: float  # part of the limit that remains while force laws stiffen
    governing_tet: int  # the tet with the highest frequency by itself
    governing: str  # what there is to say about it

    def of(self, mass: str) -> float:
        """The limit of the mass that `solver.mass` names with damping and stiffening counted, s."""
        undamped = self.stable_fraction * (self.lumped if mass == "lumped" else self.consistent)
        return damped_limit(2 / undamped, self.damping) if self.damping else undamped

    def words(self) -> str:
        """The true limits and the paper's in a sentence."""
        return (
            f"The longest stable step is {self.lumped:.3g} s with lumped mass and {self.consistent:.3g} s with consistent mass; the paper's h/c gives "
            f"{self.courant:.3g} s, {self.courant / self.lumped:.2g} and {self.courant / self.consistent:.2g} times that."
        )

    def lines(self) -> list[str]:
        """A table of all six for the screen."""
        rows = [
            ("true limit 2/omega_max, lumped mass", self.lumped, self.lumped),
            ("true limit 2/omega_max, consistent mass", self.consistent, self.consistent),
            ("Gershgorin bound, lumped mass", self.gershgorin, self.lumped),
            ("element bound, lumped mass", self.element_lumped, self.lumped),
            ("element bound, consistent mass", self.element_consistent, self.consistent),
            ("the paper's CFL h_min/c, lumped mass", self.courant, self.lumped),
            ("the paper's CFL h_min/c, consistent mass", self.courant, self.consistent),
        ]
        verdicts = ("" if step <= truth else "  NOT SAFE" for _, step, truth in rows)
        table = [f"{name:<42}{step:>11.3e} s{step / truth:>7.2f} of the truth{verdict}" for (name, step, truth), verdict in zip(rows, verdicts, strict=True)]
        return [*table, f"governed by {self.governing}"]


def damped_limit(omega: float, damping: Damping) -> float:
    """The largest stable step when the damping force lags half a step: omega^2 h^2 + 2 (a + b omega^2) h = 4.

    With one damping ratio x it is h omega = 2 (sqrt(1 + x^2) - x).
    """
    half = (damping.mass + damping.stiffness * omega**2) / omega**2
    return 4 / omega**2 / (half + math.sqrt(half**2 + 4 / omega**2))


def step_limits(
    model: ElasticModel,
    fixed: Bool[np.ndarray, "nodes 3"],
    added_stiffness: Float64[np.ndarray, " nodes"] | None = None,
    damping: Damping | None = None,
    stable_fraction: float = 1.0,
) -> StepLimits:
    """All limits of an elastic model whose `fixed` components are held and whose nodes are stiffened by `added_stiffness` (N/m).

    Gershgorin: omega_max^2 <= largest absolute row sum of M^-1/2 K M^-1/2, guaranteed for every element. Element bound:
    omega_max^2 <= the largest omega^2 of a tet by itself, with its share of the mass.
    """
    free = np.flatnonzero(~fixed.ravel())
    stiffness = model.stiffness[free][:, free]
    added = np.zeros(len(model.lumped_mass)) if added_stiffness is None else added_stiffness
    if added.any():
        stiffness = csr_matrix(stiffness + diags(np.repeat(added, 3)[free]))
    inverse_root = diags(1 / np.sqrt(LumpedMass(model, fixed).diagonal))
    scaled = csr_matrix(inverse_root @ stiffness @ inverse_root)
    lumped, consistent = _element_eigenvalues(model)
    contact = float((added / model.lumped_mass).max())  # a node's own frequency squared adds to the bound
    worst = int(lumped.argmax())
    return StepLimits(
        lumped=2 / math.sqrt(largest_eigenvalue(scaled, None)),
        consistent=2 / math.sqrt(largest_eigenvalue(stiffness, ConsistentMass(model, fixed))),
        gershgorin=2 / math.sqrt(float(abs(scaled).sum(axis=1).max())),
        element_lumped=2 / math.sqrt(float(lumped.max()) + contact),
        element_consistent=2 / math.sqrt(float(consistent.max()) + LUMPED_OVER_CONSISTENT[model.elements.is_quadratic] * contact),
        courant=model.mesh.smallest_edge / float(np.max(model.material.pressure_wave_speed)),
        damping=Damping() if damping is None else damping,
        stable_fraction=stable_fraction,
        governing_tet=worst,
        governing=_governing(model, worst, lumped),
    )


def _element_eigenvalues(model: ElasticModel) -> tuple[Float64[np.ndarray, " tets"], Float64[np.ndarray, " tets"]]:
    """The largest omega^2 of each tet by itself (1/s^2), with lumped and with consistent mass.

    Linear tets: (4 / rho) lambda_max(B'CB); five times that for the consistent mass, because B sees nothing of a
    translation and an element's consistent mass is a fifth of the lumped one on all else.
    """
    material = model.material
    if model.elements.is_quadratic:
        stiffness, mass = element_matrices(model)
        shares = np.repeat(lumped_mass_shares(model.elements, material.density), 3, axis=1)
        scaled = stiffness / np.sqrt(shares[:, :, None] * shares[:, None, :])
        lower = np.linalg.inv(np.linalg.cholesky(mass))
        return np.linalg.eigvalsh(scaled)[:, -1], np.linalg.eigvalsh(lower @ stiffness @ lower.transpose(0, 2, 1))[:, -1]
    gradients = shape_gradients(model.mesh)
    blocks = (
        per_tet(material.lame_lambda, 4) * np.einsum("tia,tjb->tiajb", gradients, gradients)
        + per_tet(material.lame_mu, 4) * np.einsum("tib,tja->tiajb", gradients, gradients)
        + per_tet(material.lame_mu, 4) * np.einsum("tic,tjc,ab->tiajb", gradients, gradients, np.eye(3))
    )
    lumped = 4 / material.density * np.linalg.eigvalsh(blocks.reshape(-1, 12, 12))[:, -1]
    return lumped, 5 * lumped


def _governing(model: ElasticModel, tet: int, squared: Float64[np.ndarray, " tets"]) -> str:
    """The tet that makes the step small, and what the step would be without it and its like."""
    mesh, material = model.mesh, model.material
    corners = mesh.nodes[mesh.tets[tet]]
    areas = [np.linalg.norm(np.cross(*(np.delete(corners, k, axis=0)[1:] - np.delete(corners, k, axis=0)[0]))) / 2 for k in range(4)]
    altitude = 3 * mesh.volumes[tet] / max(areas)
    x, y, z = corners.mean(axis=0)
    gain = math.sqrt(float(squared[tet] / np.quantile(squared, 0.99)))
    made_of = "" if isinstance(material, Material) else f", of Young's modulus {material.youngs_modulus[tet]:.4g} Pa"
    return (
        f"tet {tet} at ({x:.4g}, {y:.4g}, {z:.4g}) m, smallest altitude {altitude:.3g} m{made_of}; "
        f"without the worst hundredth of the tets the element bound would be {gain:.2f} times as large"
    )
