"""The reference cases of elasticity and of time stepping: exact answers beside what this code finds, as a user's scene would find it."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from sdfnet.verification.beams import bar_mode, cantilever
from sdfnet.verification.conservation import energy, free_rigid_motion
from sdfnet.verification.half_space import disc_on_half_space
from sdfnet.verification.loads import blow_within_a_step, free_fall, sudden_load
from sdfnet.verification.manufactured import manufactured
from sdfnet.verification.polynomials import hanging_bar, hydrostatic, patch, pure_bending
from sdfnet.verification.row import Row
from sdfnet.verification.step_limits import damping, step_limit
from sdfnet.verification.units import units

Case = Callable[[], Iterator[Row]]

CASES: dict[str, Case] = {
    case.__name__: case
    for case in (
        patch,
        pure_bending,
        hanging_bar,
        hydrostatic,
        bar_mode,
        cantilever,
        disc_on_half_space,
        free_rigid_motion,
        energy,
        step_limit,
        damping,
        manufactured,
        free_fall,
        sudden_load,
        blow_within_a_step,
        units,
    )
}


def rows_of(name: str) -> list[Row]:
    """Run one reference case; its docstring has the equation. Raises what its scenes raise: a case that cannot be run has no rows."""
    return [replace(row, case=name) for row in CASES[name]()]


__all__ = ["CASES", "Case", "Row", "rows_of"]
