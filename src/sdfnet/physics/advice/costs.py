"""What an effect costs per step and in the number of steps, in words."""

import math
import time
from collections.abc import Callable

import torch

from sdfnet.physics.effects.roles import ConservingLaw, Damping, ForceLaw
from sdfnet.physics.integrators.integrator import torch_csr
from sdfnet.physics.plan import Plan
from sdfnet.physics.stability import damped_limit

VISIBLE = 1.05  # a factor on the number of steps under which the cost does not mention it
CALLS = 9  # the fastest of which shows what one takes when nothing else runs


def damping_cost(compiled: Plan, damping: Damping) -> str:
    """Two vectors scaled, and shorter steps where the damping grows with the frequency."""
    if compiled.limits is None:
        return "nothing per step that shows"
    omega = 2 / compiled.limits.lumped
    return f"one or two vectors scaled per step{_more_steps(2 / omega / damped_limit(omega, damping))}"


def law_cost(compiled: Plan, law: ForceLaw, replaces_elasticity: bool) -> str:
    """Time of a force law beside that of the sparse product of a plain step, both measured here, and the shorter steps that it needs."""
    displacement = torch.zeros(law.added_stiffness().shape[0], 3, dtype=torch.float64)
    matrix, column = torch_csr(compiled.model.stiffness), torch.zeros(compiled.fixed.size, 1, dtype=torch.float64)
    plain, forced = _seconds(lambda: matrix @ column), _seconds(lambda: law.force(displacement.clone(), 0.0))
    place = ", which it replaces" if replaces_elasticity else ""
    per_step = f"one force law per step, about {forced / plain:.2g} times the sparse product of a plain step{place}"
    if compiled.limits is None:
        return f"{per_step}; and it needs solver.integrator=leapfrog"
    if isinstance(law, ConservingLaw) and compiled.scene.solver.mass != "lumped":
        per_step += "; it needs solver.mass=lumped"
    masses = compiled.model.lumped_mass[: len(displacement)]
    contact = float((law.added_stiffness() / masses).max()) * (compiled.limits.lumped / 2) ** 2
    return per_step + _more_steps(math.sqrt(1 + contact) / law.stable_fraction)


def _more_steps(factor: float) -> str:
    return f", and up to {factor:.2g} times the steps" if factor > VISIBLE else ""


def _seconds(call: Callable[[], object]) -> float:
    seconds = []
    for _ in range(CALLS):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)
