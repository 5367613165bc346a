"""Where the energy of a state is: in motion, in strain, in the loads."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import csr_matrix, diags

from sdfnet.errors import ConfigurationError
from sdfnet.physics.plan import Plan


@dataclass(frozen=True)
class Energies:
    """All in J. Their sum is kept where only constant loads act and nothing damps."""

    kinetic: float  # 1/2 v'Mv
    strain: float  # 1/2 u'Ku of the linear elastic force, zero where a law takes its place
    load: float  # -f'u: the potential of the loads, zero at rest
    laws: float  # stored by forces that follow the state: hyperelasticity, contact

    @property
    def total(self) -> float:
        """The sum, J."""
        return self.kinetic + self.strain + self.load + self.laws


def energies(
    compiled: Plan, displacement: Float64[np.ndarray, "nodes 3"], velocity: Float64[np.ndarray, "nodes 3"], time: float = 0.0, case: str | None = None
) -> Energies:
    """The energies of a state (m, m/s) at a time (s) that loads with a history and moving fingers go by.

    A row is a node of `compiled.model.elements`; the mass is the one that `solver.mass` names. `case` names the load case
    that acts beside the effects. Of what leapfrog or symplectic Euler keep, this is the plain part: it swings by
    about h omega, and their `energy` adds what makes it constant. Raises ConfigurationError for a case that is none.
    """
    demands, model = compiled.demands, compiled.model
    if (case is None) == bool(demands.case_loads) or (case is not None and case not in demands.case_loads):
        known = list(demands.case_loads)
        raise ConfigurationError(f"energies need one of the scene's load cases {known}, found {case}; give its name as case, or None if it has none")
    loads = [*demands.loads.values(), *([] if case is None else [demands.case_loads[case]])]
    lumped = compiled.scene.solver.mass == "lumped"
    mass = csr_matrix(diags(model.lumped_mass)) if lumped else model.consistent_mass
    flat = displacement.reshape(-1)
    return Energies(
        kinetic=0.5 * float((velocity * (mass @ velocity)).sum()),
        strain=0.0 if demands.replaces_elasticity else 0.5 * float(flat @ (model.stiffness @ flat)),
        load=sum((-load.history.factor(time) * float((load.nodal_force * displacement).sum()) for load in loads), 0.0),
        laws=sum((law.stored_energy(torch.from_numpy(displacement), time) for law in demands.laws.values()), 0.0),
    )
