"""Time integrators, one a file, all over the free degrees of freedom and over many load cases as columns."""

from sdfnet.physics.integrators.exact import Exact
from sdfnet.physics.integrators.integrator import Integrator
from sdfnet.physics.integrators.leapfrog import Leapfrog
from sdfnet.physics.integrators.modal import Modal
from sdfnet.physics.integrators.newmark import Newmark
from sdfnet.physics.integrators.symplectic_euler import SymplecticEuler

INTEGRATORS: dict[str, type[Integrator]] = {
    "leapfrog": Leapfrog,
    "symplectic_euler": SymplecticEuler,
    "newmark": Newmark,
    "modal": Modal,
    "exact": Exact,
}

__all__ = ["INTEGRATORS", "Exact", "Integrator", "Leapfrog", "Modal", "Newmark", "SymplecticEuler"]
