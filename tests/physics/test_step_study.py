"""The table of what the time step costs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.elasticity import assemble
from sdfnet.physics.step_study import StepStudy, relative_difference, time_step_study
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
PUSH = PressurePoke(center=(0.5, 0.5, 1.5), radius=0.3, pressure=10.0)
EFFECTS = {"foot": Pinned(), "push": PUSH}
SCENE = Scene(Geometry(), EFFECTS, recording=Recording(duration=0.03, frames=7))


@pytest.fixture(scope="module")
def tower(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 1, 4), np.linspace(0, 1, 4), np.linspace(0, 1.5, 5))


@pytest.fixture(scope="module")
def study(tower: TetMesh) -> StepStudy:
    return time_step_study(SCENE, tower)


def test_symplectic_euler_is_first_order_and_leapfrog_second(study: StepStudy) -> None:
    fitted = {(row.mass, row.integrator): row.order for row in study.rows}  # the finest pair of each
    for mass in ("lumped", "consistent"):
        assert fitted[mass, "symplectic_euler"] == pytest.approx(1, abs=0.2)
        assert fitted[mass, "leapfrog"] == pytest.approx(2, abs=0.2)


def test_leapfrog_is_better_at_the_same_step(study: StepStudy) -> None:
    errors = {(row.mass, row.integrator, row.steps): row.relative_error for row in study.rows}
    for (mass, integrator, steps), error in errors.items():
        if integrator == "leapfrog":
            assert error < errors[mass, "symplectic_euler", steps]


def test_the_masses_differ_by_more_than_the_step_does(study: StepStudy) -> None:
    assert study.mass_difference > 2 * max(row.relative_error for row in study.rows if row.integrator == "leapfrog")
    assert study.mass_difference < 0.5


def test_the_table_has_a_line_for_each_run_and_one_for_the_masses(study: StepStudy) -> None:
    lines = study.lines()
    assert len(lines) == 1 + len(study.rows) + 1
    assert lines[1].startswith("lumped     symplectic_euler")
    assert lines[-1].startswith("lumped against consistent mass over 0.03 s: ")


def test_a_shorter_duration_studies_the_first_frames_of_one_mass(tower: TetMesh) -> None:
    study = time_step_study(SCENE, tower, duration=0.0101, masses=("lumped",))
    assert study.duration == pytest.approx(0.01)
    assert {row.mass for row in study.rows} == {"lumped"}
    with pytest.raises(ConfigurationError, match=r"found a duration of 0.001 s with frames every 0.005 s"):
        time_step_study(SCENE, tower, duration=0.001)


def test_quadratic_elements_are_studied_by_the_corners_that_the_frames_hold(make_box: MakeBox) -> None:
    small = make_box([0, 1], [0, 1], [0, 0.75, 1.5])
    study = time_step_study(replace(SCENE, solver=Solver(element="P2", safety=0.4)), small, duration=0.0101, masses=("lumped",))
    fitted = {row.integrator: row.order for row in study.rows}
    assert fitted["leapfrog"] == pytest.approx(2, abs=0.2)
    assert fitted["symplectic_euler"] == pytest.approx(1, abs=0.2)


def test_load_cases_are_studied_together(tower: TetMesh) -> None:
    cases: dict[str, Effect] = {"push": PUSH, "pull": replace(PUSH, pressure=-20.0)}
    together = time_step_study(replace(SCENE, effects={"foot": Pinned()}, load_cases=cases), tower, duration=0.0101, masses=("lumped",))
    alone = time_step_study(SCENE, tower, duration=0.0101, masses=("lumped",))
    errors = [[row.relative_error for row in study.rows] for study in (together, alone)]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-9)  # a pull is a push turned round, and errors are relative


def test_the_difference_weighs_each_node_by_its_mass_over_all_frames(tower: TetMesh) -> None:
    model = assemble(tower, Material(density=3.0))
    times = np.array([0.0, 1.0])
    reference = Trajectory(tower, times, np.ones((2, len(tower.nodes), 3)), 1.0, {})
    other = replace(reference, displacements=reference.displacements.copy())
    other.displacements[1, 0, 2] += 0.5
    expected = np.sqrt(0.25 * model.lumped_mass[0] / (2 * 3 * model.lumped_mass.sum()))
    assert relative_difference(other, reference, "lumped", model) == pytest.approx(expected, rel=1e-12)


def test_a_scene_that_never_moves_cannot_be_studied(tower: TetMesh) -> None:
    with pytest.raises(PhysicsError, match="needs a motion to compare with, found the rest state in every frame; add a load"):
        time_step_study(replace(SCENE, effects={"foot": Pinned()}), tower)


def test_an_unknown_mass_is_refused_with_the_known_ones(tower: TetMesh) -> None:
    with pytest.raises(ConfigurationError, match="solver.mass must be one of lumped, consistent; found 'lump'"):
        time_step_study(SCENE, tower, masses=("lump",))
