"""Every reference case of elasticity and time stepping at its tolerance: the same rows that `python verify.py` prints."""

import pytest

from sdfnet.verification import CASES, rows_of

IN_NUMERICS = (
    "patch",
    "pure_bending",
    "hanging_bar",
    "hydrostatic",
    "bar_mode",
    "cantilever",
    "disc_on_half_space",
    "free_rigid_motion",
    "energy",
    "step_limit",
    "damping",
    "manufactured",
    "free_fall",
    "sudden_load",
    "blow_within_a_step",
    "units",
)


@pytest.mark.parametrize("name", CASES)
def test_what_is_found_is_as_near_to_the_exact_answer_as_the_table_asks(name: str) -> None:
    rows = rows_of(name)
    assert rows
    assert [f"{row.setup}: {row.quantity} {row.found:.6g} for {row.exact:.6g}, must be {row.criterion}" for row in rows if not row.passes] == []
    assert {row.case for row in rows} == {name}
    assert len({(row.setup, row.quantity) for row in rows}) == len(rows), "two rows cannot be told apart"


def test_the_table_holds_every_case() -> None:
    assert tuple(CASES) == IN_NUMERICS


@pytest.mark.parametrize("name", CASES)
def test_every_case_says_what_it_solves(name: str) -> None:
    assert len(CASES[name].__doc__ or "") > 40
