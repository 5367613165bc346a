"""What time step, mass, elements and mesh cost: orders, references, and failures that keep their place."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.cost import simulation_study
from sdfnet.cost.findings import findings_of, front_of
from sdfnet.cost.simulation_study import _stepped, clocked, exact_in_time, first_part, rms_mm, simulation_time_study
from sdfnet.cost.space_study import displacements_at, simulation_space_study
from sdfnet.cost.studies import Point, Study
from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.solids import Box, Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.simulate import Progress, run
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Material, Recording, Scene, Solver

BAR = Box(size=(1.0, 0.5, 0.5), cells=(4, 2, 2))
EFFECTS = {
    "wall": Pinned(HalfSpace(normal=(1.0, 0.0, 0.0))),
    "push": PressurePoke(center=(1.0, 0.25, 0.25), radius=0.3, pressure=10.0),
}
SCENE = Scene(BAR, EFFECTS, Material(), Recording(duration=0.04, frames=9))


@pytest.fixture(scope="module")
def mesh() -> TetMesh:
    return BAR.tet_mesh()


@pytest.fixture(scope="module")
def in_time(mesh: TetMesh) -> Study:
    return simulation_time_study(SCENE, mesh)


@pytest.fixture(scope="module")
def in_space(mesh: TetMesh) -> Study:
    return simulation_space_study(SCENE, mesh, mesh_seconds=100.0)


def errors_of(study: Study, method: str) -> list[float]:
    found = [point.error_mm for point in study.points if point.method == method]
    assert found
    assert all(error is not None for error in found)
    return [error for error in found if error is not None]


def default_of(study: Study) -> Point:
    (point,) = [point for point in study.points if point.is_default]
    return point


def test_set_up_is_counted_once_for_the_whole_motion(monkeypatch: pytest.MonkeyPatch, mesh: TetMesh) -> None:
    def second_of_set_up_and_one_of_steps(compiled: Plan, progress: Progress) -> Trajectory:
        clock[0] += 2.0
        progress(1, 1)
        return Trajectory(mesh, np.zeros(1), np.zeros((1, len(mesh.nodes), 3)), 1.0, {"step_seconds": 1.0})

    clock, third = [0.0], plan(replace(SCENE, recording=Recording(duration=0.01, frames=3)), mesh)
    monkeypatch.setattr(simulation_study, "run", second_of_set_up_and_one_of_steps)
    monkeypatch.setattr(simulation_study.time, "perf_counter", lambda: clock[0])
    assert clocked(third, 0.03)[1:] == (2.0, pytest.approx(4.0))
    assert clocked(third, 0.01)[1:] == (2.0, 2.0)


def test_whole_motion_is_the_scene_itself_whatever_its_duration_is_rounded_to() -> None:
    scene = replace(SCENE, recording=Recording(duration=0.03, frames=8))
    assert 7 * (0.03 / 7) != 0.03
    assert first_part(scene, 0.03) == scene


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_halving_the_step_quarters_leapfrogs_error_and_halves_symplectic_eulers(in_time: Study, mesh: TetMesh, mass: str) -> None:
    """Fitted to half and a quarter of the auto step; symplectic Euler still has some of leapfrog's second order there."""
    base = plan(replace(SCENE, solver=Solver(mass=mass)), mesh)
    reference, surface = exact_in_time(base), mesh.surface_nodes
    for integrator, order, tolerance in (("leapfrog", 2, 0.1), ("symplectic_euler", 1, 0.3)):
        _, half, *finer = errors_of(in_time, f"{integrator.replace('_', ' ')}, {mass} mass")
        quarter = rms_mm(run(_stepped(base, integrator, 4 * base.steps_per_frame)).displacements[:, surface], reference[:, surface])
        assert finer == ([pytest.approx(quarter)] if mass == "lumped" else []), "a consistent mass is dear, and its finest step is left out"
        assert math.log2(half / quarter) == pytest.approx(order, abs=tolerance)


def test_notes_tell_the_fitted_orders_and_how_far_the_masses_lie_apart(in_time: Study) -> None:
    text = " ".join(in_time.notes)
    orders = {name: float(order) for name, order in re.findall(r"(\w+, \w+) mass: observed order ([\d.]+)", text)}
    assert set(orders) == {"leapfrog, lumped", "euler, lumped", "leapfrog, consistent", "euler, consistent"}
    assert orders["leapfrog, lumped"] == pytest.approx(2, abs=0.2)
    # A leapfrog shifted by half a step, whose second order is still seen at the longest; so coarse a solid has few modes to average over.
    assert orders["euler, lumped"] == pytest.approx(1, abs=0.5)
    apart = re.search(r"Lumped and consistent mass differ by ([\d.]+) %", text)
    assert apart is not None
    assert 0.1 < float(apart[1]) < 50
    assert all(note in findings_of(in_time) for note in in_time.notes)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_longer_newmark_steps_and_fewer_modes_are_worse(in_time: Study, mass: str) -> None:
    newmark, modal = errors_of(in_time, f"newmark, {mass} mass"), errors_of(in_time, f"modal, {mass} mass")
    assert newmark == sorted(newmark)
    assert modal == sorted(modal, reverse=True)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_reference_is_the_solution_by_all_modes(mesh: TetMesh, mass: str) -> None:
    scene = replace(SCENE, solver=Solver(mass=mass))
    base = plan(scene, mesh)
    everything = int((~base.fixed).sum())
    by_modes = run(plan(replace(scene, solver=Solver("modal", mass, modes=everything)), mesh)).displacements
    reference = exact_in_time(base)
    leapfrog = rms_mm(run(base).displacements, by_modes)
    # Lumped: to rounding. Consistent: an eighth of the step alone would leave 1/64 = 0.016, of which extrapolation takes most.
    assert rms_mm(reference, by_modes) < {"lumped": 1e-8, "consistent": 0.008}[mass] * leapfrog


def test_damped_reference_is_not_extrapolated(mesh: TetMesh) -> None:
    """Leapfrog's damping force lags: an error of first order, which the formula for second order would not remove."""
    scene = replace(SCENE, effects=EFFECTS | {"damping": RayleighDamping(mass=20.0)})
    base = plan(scene, mesh)
    fine = run(replace(base, steps_per_frame=8 * base.steps_per_frame)).displacements
    np.testing.assert_array_equal(exact_in_time(base), fine)


def test_labels_say_what_part_of_the_motion_it_is_and_what_the_reference_is(mesh: TetMesh, in_time: Study) -> None:
    assert in_time.error_label == "RMS displacement error against the exact-in-time solution, same mass (mm)"
    assert in_time.cost_label == "set-up and steps, 40 ms of motion (s)"
    assert in_time.part == ""
    quarter = simulation_time_study(SCENE, mesh, duration=0.01, quick=True)
    assert quarter.cost_label == in_time.cost_label
    assert quarter.part.startswith("Errors and counts are those of the first 10 of 40 ms of motion; seconds are estimated for all of it")
    eighth = simulation_space_study(SCENE, mesh, 0.0, duration=0.005, quick=True)
    assert eighth.cost_label == "mesh, set-up and steps, 40 ms of motion (s)"
    assert "the first 5 of 40 ms" in eighth.part
    damped = replace(SCENE, effects=EFFECTS | {"damping": RayleighDamping(mass=20.0)})
    label = simulation_time_study(damped, mesh, duration=0.005, quick=True).error_label
    assert label == "RMS displacement error against leapfrog with 1/8 of the auto step, same mass (mm)"


def test_each_mass_has_its_own_reference(in_time: Study, in_space: Study) -> None:
    """The masses differ by far more than what leapfrog errs with either: that is a matter of the mesh, and of the study in space."""
    finest = [errors_of(in_time, f"leapfrog, {mass} mass")[-1] for mass in ("lumped", "consistent")]
    lumped, consistent = (errors_of(in_space, f"P1, {mass} mass")[0] for mass in ("lumped", "consistent"))
    assert abs(lumped - consistent) > 2 * max(finest)  # with the other mass's reference an error were at least that difference


def test_one_point_is_the_scenes_own_and_needs_no_override(in_time: Study, in_space: Study) -> None:
    default = default_of(in_time)
    assert (default.method, default.overrides) == ("leapfrog, lumped mass", ())
    assert default_of(in_space).method == "P1, lumped mass"
    assert default_of(in_space).setting == "the scene's mesh"
    assert all(point.overrides for study in (in_time, in_space) for point in study.points if not point.is_default)


@pytest.mark.parametrize("solver", [Solver("newmark"), Solver("symplectic_euler", "consistent"), Solver("modal", modes=7), Solver(time_step=5e-4)])
def test_a_scene_of_any_solver_finds_itself(mesh: TetMesh, solver: Solver) -> None:
    default = default_of(simulation_time_study(replace(SCENE, solver=solver), mesh, duration=0.01, quick=True))
    assert default.is_measured
    assert default.overrides == ()


def test_exact_integrator_of_a_scene_is_the_reference_and_on_no_front(mesh: TetMesh) -> None:
    study = simulation_time_study(replace(SCENE, solver=Solver("exact")), mesh, duration=0.01, quick=True)
    assert default_of(study).is_reference
    assert default_of(study) not in front_of(study)


def test_overrides_give_the_run_that_was_measured(in_time: Study, mesh: TetMesh) -> None:
    point = [point for point in in_time.points if point.method == "newmark, consistent mass"][-1]
    changes = dict(override.removeprefix("dataset.scene.solver.").split("=") for override in point.overrides)
    assert changes.keys() == {"integrator", "mass", "time_step"}
    solver = Solver(changes["integrator"], changes["mass"], time_step=float(changes["time_step"]))
    assert plan(replace(SCENE, solver=solver), mesh).steps == point.counts["steps"] == point.counts["sparse_solves"]


def test_what_a_method_cannot_do_is_a_failed_point_with_the_reason(mesh: TetMesh) -> None:
    """The energy watch stops a run over the limit; a damped motion has no exact integrator; both leave their place."""
    scene = replace(SCENE, solver=Solver("exact"), effects=EFFECTS | {"damping": RayleighDamping(mass=20.0)})
    default = default_of(simulation_time_study(scene, mesh, duration=0.01, quick=True))
    assert not default.is_measured
    assert default.failure is not None
    assert "cannot integrate damping" in default.failure
    assert default.seconds is None


def test_finer_meshes_come_nearer_to_quadratic_tets_and_cost_more(in_space: Study) -> None:
    own, coarse, fine = (point for point in in_space.points if point.method == "P1, lumped mass")
    assert (coarse.overrides, fine.overrides) == (("dataset.scene.geometry.cells=[2,1,1]",), ("dataset.scene.geometry.cells=[8,4,4]",))
    assert None not in (own.error_mm, coarse.error_mm, fine.error_mm)
    assert fine.error_mm < 0.7 * own.error_mm < 0.7 * coarse.error_mm  # type: ignore[operator]
    assert fine.counts["tets"] == 8 * own.counts["tets"] == 64 * coarse.counts["tets"]


def test_reference_in_space_is_quadratic_and_has_no_error(in_space: Study) -> None:
    (quadratic,) = [point for point in in_space.points if point.method.startswith("P2")]
    assert quadratic.error_mm == 0.0
    assert quadratic.is_reference
    assert [point.method for point in in_space.points if point.is_reference] == [quadratic.method]
    assert quadratic.counts["nodes"] > 4 * len(BAR.tet_mesh().nodes)


def test_seconds_in_space_hold_those_of_the_given_mesh_and_of_no_other(in_space: Study) -> None:
    for point in in_space.points:
        assert point.seconds is not None
        assert (point.seconds.median > 100.0) == (point.setting == "the scene's mesh")


def test_what_cannot_be_run_on_another_mesh_is_a_failed_point(mesh: TetMesh) -> None:
    """The geometry says a ball, whose surface the push does not reach."""
    study = simulation_space_study(replace(SCENE, geometry=Sphere(radius=0.2, cells=2)), mesh, 0.0, duration=0.005)
    failed = [point for point in study.points if point.failure is not None]
    assert [point.overrides for point in failed] == [("dataset.scene.geometry.cells=1",), ("dataset.scene.geometry.cells=4",)]
    assert not any(point.is_measured for point in failed)


def test_a_linear_displacement_is_read_exactly_between_the_nodes(mesh: TetMesh) -> None:
    gradient = np.array([[0.1, 0.2, 0.0], [0.0, -0.1, 0.3], [0.2, 0.0, 0.1]])
    trajectory = Trajectory(mesh, np.zeros(1), (mesh.nodes @ gradient)[None], 1.0, {})
    finer = replace(BAR, cells=(7, 3, 5)).tet_mesh()
    points = finer.nodes[finer.surface_nodes]
    np.testing.assert_allclose(displacements_at(points, trajectory)[0], points @ gradient, atol=1e-9)


def test_a_point_off_the_surface_moves_as_the_place_nearest_to_it(mesh: TetMesh) -> None:
    trajectory = Trajectory(mesh, np.zeros(1), mesh.nodes[None].copy(), 1.0, {})
    np.testing.assert_allclose(displacements_at(np.array([[1.3, 0.2, 0.3]]), trajectory), [[[1.0, 0.2, 0.3]]], atol=1e-9)


def test_error_is_the_root_of_the_mean_square_length_in_mm() -> None:
    displacements = np.zeros((2, 2, 3))
    displacements[1, 0] = [3e-3, 0.0, 4e-3]
    assert rms_mm(displacements, np.zeros((2, 2, 3))) == pytest.approx(5 / 2, rel=1e-12)


def test_a_study_needs_a_frame_and_a_motion(mesh: TetMesh) -> None:
    with pytest.raises(ConfigurationError, match=r"found a duration of 0.001 s with frames every 0.005 s"):
        simulation_time_study(SCENE, mesh, duration=0.001)
    with pytest.raises(PhysicsError, match="found a scene that stays at rest; add a load"):
        simulation_time_study(replace(SCENE, effects={"wall": EFFECTS["wall"]}), mesh)
