"""Whole runs against closed forms, and runs that break down."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.errors import PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.history import History, ramp
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.elasticity import finite_elements
from sdfnet.physics.energy_watch import ENERGY_TOLERANCE
from sdfnet.physics.integrators import INTEGRATORS, Newmark
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.simulate import SimulationStopped, run, simulate
from sdfnet.physics.stability import StepLimits
from sdfnet.scene import Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
PUSH = PressurePoke(center=(0.5, 0.5, 1.0), radius=0.2, pressure=10.0)
HELD = Scene(Geometry(), {"foot": Pinned(), "push": PUSH}, recording=Recording(duration=0.02, frames=6))


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("material", [Material(), Material(youngs_modulus=2.1e11, poisson_ratio=0.29, density=7850.0)])
def test_the_end_of_a_pushed_bar_moves_with_pressure_over_impedance_until_the_wave_returns(make_box: MakeBox, mass: str, material: Material) -> None:
    length, speed = 0.5, material.pressure_wave_speed
    width, pressure = length / 40, 1e-3 * material.youngs_modulus
    mesh = make_box(np.linspace(0, length, 41), [0, width], [0, width])
    effects = {
        "wall": Pinned(HalfSpace(normal=(1.0, 0.0, 0.0))),
        "rollers": Pinned(HalfSpace((length, 0.0, 0.0), (1.0, 0.0, 0.0)), components=(False, True, True)),
        "push": PressurePoke(center=(length, width / 2, width / 2), radius=0.8 * width, pressure=pressure, direction=None),
    }
    scene = Scene(Geometry(), effects, material, Recording(duration=2 * length / speed, frames=11), Solver(mass=mass))
    trajectory = simulate(scene, mesh)
    end = mesh.nodes[:, 0] == length
    exact = -pressure / (material.density * speed) * trajectory.times
    np.testing.assert_allclose(trajectory.displacements[:, end, 0].mean(axis=1), exact, atol=0.02 * np.abs(exact).max())  # wave front over 2 of 40 elements
    assert np.abs(trajectory.displacements[:, :, 1:]).max() == 0


def test_a_free_solid_under_a_body_force_falls_by_half_a_t_squared(cube: TetMesh) -> None:
    acceleration = np.array([1.0, -2.0, 3.0])
    scene = Scene(Geometry(), {"weight": BodyForce(density=(7.0, -14.0, 21.0))}, Material(density=7.0, youngs_modulus=1e6), HELD.recording)
    trajectory = simulate(scene, cube)
    exact = 0.5 * trajectory.times[:, None, None] ** 2 * acceleration
    np.testing.assert_allclose(trajectory.displacements, np.broadcast_to(exact, trajectory.displacements.shape), atol=1e-12)  # leapfrog is exact for it


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_free_solid_under_a_rising_body_force_falls_by_a_sixth_of_a_t_cubed(cube: TetMesh, integrator: str) -> None:
    weight = BodyForce(density=(7.0, -14.0, 21.0), history=ramp(0.04))  # half of it after 0.02 s
    solver = Solver(integrator, time_step=1e-4, modes=1000)
    trajectory = simulate(Scene(Geometry(), {"weight": weight}, Material(density=7.0), HELD.recording, solver), cube)
    exact = trajectory.times[:, None, None] ** 3 / (6 * 0.04) * np.array([1.0, -2.0, 3.0])
    tolerance = 1e-9 if integrator in ("modal", "exact") else 0.01  # a step is a two hundredth of the time: first order errs by three of them at most
    np.testing.assert_allclose(trajectory.displacements[-1], np.broadcast_to(exact[-1], cube.nodes.shape), atol=tolerance * np.abs(exact).max())


def test_a_constant_history_scales_the_load(cube: TetMesh) -> None:
    plain, doubled = (simulate(replace(HELD, effects={"foot": Pinned(), "push": push}), cube) for push in (PUSH, replace(PUSH, history=History(values=(2.0,)))))
    np.testing.assert_allclose(doubled.displacements, 2 * plain.displacements, rtol=0, atol=1e-13 * np.abs(plain.displacements).max())


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_momentum_of_a_free_solid_comes_from_the_load_alone(cube: TetMesh, mass: str) -> None:
    scene = replace(HELD, effects={"push": PUSH}, solver=Solver(mass=mass))
    compiled = plan(scene, cube)
    trajectory = run(compiled)
    center = np.einsum("n,fnc->fc", compiled.model.lumped_mass, trajectory.displacements) / compiled.model.lumped_mass.sum()
    exact = 0.5 * trajectory.times[:, None] ** 2 * compiled.equation().constant_force.reshape(-1, 3).sum(axis=0) / compiled.model.lumped_mass.sum()
    np.testing.assert_allclose(center, exact, atol=1e-10 * np.abs(exact).max())


def test_millimetres_and_metres_give_the_same_motion(make_box: MakeBox) -> None:
    axis = np.linspace(0, 0.02, 4)
    metres = make_box(axis, axis, axis, jitter=0.2)
    millimetres = TetMesh(1000 * metres.nodes, metres.tets)
    recording = Recording(duration=5e-4, frames=4)
    in_metres = Scene(Geometry(), {"foot": Pinned(), "poke": PressurePoke((0.01, 0.01, 0.02), 0.003, 40.0)}, Material(5e3, 0.4, 1.0), recording)
    # kg mm^-1 s^-2 = 1e-3 Pa, kg mm^-3 = 1e-9 kg/m^3
    in_millimetres = Scene(Geometry(), {"foot": Pinned(), "poke": PressurePoke((10.0, 10.0, 20.0), 3.0, 0.04)}, Material(5.0, 0.4, 1e-9), recording)
    expected, found = simulate(in_metres, metres), simulate(in_millimetres, millimetres)
    assert found.report["steps"] == expected.report["steps"]
    largest = np.abs(expected.displacements).max()
    assert largest > 1e-6
    np.testing.assert_allclose(found.displacements / 1000, expected.displacements, atol=1e-10 * largest)


def test_frames_are_the_recorded_times_from_rest_on_and_held_nodes_stay(cube: TetMesh) -> None:
    seen: list[tuple[int, int]] = []
    trajectory = simulate(HELD, cube, lambda done, total: seen.append((done, total)))
    np.testing.assert_allclose(trajectory.times, [0, 0.004, 0.008, 0.012, 0.016, 0.02], atol=1e-15)
    assert seen == [(1, 5), (2, 5), (3, 5), (4, 5), (5, 5)]
    assert not trajectory.displacements[0].any()
    assert not trajectory.displacements[:, Pinned().fixed_components(finite_elements(cube))].any()
    assert np.all(np.abs(trajectory.displacements[1:]).max(axis=(1, 2)) > 0)
    np.testing.assert_array_equal(trajectory.surface(5).vertices, cube.surface(trajectory.displacements[5]).vertices)


def test_a_frame_does_not_depend_on_how_many_are_saved(cube: TetMesh) -> None:
    solver = Solver(time_step=1e-4)
    few = simulate(replace(HELD, recording=Recording(0.02, 2), solver=solver), cube)
    many = simulate(replace(HELD, recording=Recording(0.02, 11), solver=solver), cube)
    np.testing.assert_allclose(few.displacements[-1], many.displacements[-1], atol=1e-12 * np.abs(few.displacements).max())


def test_the_report_says_how_it_was_made_and_how_well(cube: TetMesh) -> None:
    compiled = plan(HELD, cube)
    report = run(compiled).report
    assert report["steps"] == compiled.steps
    assert report["limit_lumped_s"] == limits_of(compiled).lumped
    assert report["push_loaded_area_m2"] == pytest.approx(np.pi * 0.04, rel=0.01)
    assert report["frames_with_inverted_tets"] == 0
    assert 0 < float(report["energy_drift"]) < 1e-12  # rounding; ENERGY_TOLERANCE is far above


def test_a_step_one_percent_over_the_limit_is_caught_before_step_200_and_good_frames_are_kept(cube: TetMesh) -> None:
    compiled = plan(HELD, cube)
    limit = limits_of(compiled).lumped
    over = replace(compiled, scene=replace(HELD, recording=Recording(duration=1.01 * limit * 400, frames=41)), steps_per_frame=10)
    with pytest.raises(SimulationStopped, match=r"found a drift of .*; the last good frame is \d+, t = .*1.010 of the stable limit: lower") as caught:
        run(over)
    kept = caught.value.trajectory
    assert 10 * len(kept.times) <= 200
    np.testing.assert_array_equal(kept.displacements, run(replace(over, scene=_frames(over.scene, len(kept.times)))).displacements)


def test_one_percent_under_the_limit_runs_ten_thousand_steps(cube: TetMesh) -> None:
    compiled = plan(HELD, cube)
    long = Recording(duration=0.99 * limits_of(compiled).lumped * 10_000, frames=11)
    trajectory = run(replace(compiled, scene=replace(HELD, recording=long), steps_per_frame=1000))
    assert np.isfinite(trajectory.displacements).all()
    assert float(trajectory.report["energy_drift"]) <= ENERGY_TOLERANCE


@pytest.mark.parametrize("damping", [RayleighDamping(mass=20.0), RayleighDamping(stiffness=3e-4)])
@pytest.mark.parametrize("integrator", ["leapfrog", "symplectic_euler"])
def test_with_damping_too_the_limit_is_where_runs_break_down(cube: TetMesh, damping: RayleighDamping, integrator: str) -> None:
    scene = replace(HELD, effects={**HELD.effects, "damping": damping}, solver=Solver(integrator))
    compiled = plan(scene, cube)
    limit = limits_of(compiled).of("lumped")
    assert limit < 0.99 * limits_of(compiled).lumped
    over = replace(compiled, scene=replace(scene, recording=Recording(duration=1.01 * limit * 400, frames=41)), steps_per_frame=10)
    with pytest.raises(SimulationStopped, match=r"of the stable limit: lower") as caught:
        run(over)
    assert 10 * len(caught.value.trajectory.times) <= 200
    under = replace(compiled, scene=replace(scene, recording=Recording(duration=0.99 * limit * 10_000, frames=101)), steps_per_frame=100)
    trajectory = run(under)
    assert float(trajectory.report["energy_drift"]) <= 1e-12  # rounding: no step gains
    assert np.abs(np.diff(trajectory.displacements[-10:], axis=0)).max() < 0.1 * np.abs(trajectory.displacements).max()  # it has come to rest, or nearly


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_every_integrator_records_the_same_motion(cube: TetMesh, integrator: str) -> None:
    recording = Recording(duration=0.02, frames=41)  # frames so near that Newmark's automatic step follows the poke
    effects = {**HELD.effects, "push": replace(PUSH, history=ramp(0.01))}
    expected = simulate(replace(HELD, effects=effects, recording=recording, solver=Solver("exact")), cube)
    solver = Solver(integrator, time_step=1e-4 if INTEGRATORS[integrator].is_explicit else "auto", modes=1000)
    found = simulate(replace(HELD, effects=effects, recording=recording, solver=solver), cube)
    assert found.report["integrator"] == integrator
    np.testing.assert_allclose(found.displacements, expected.displacements, rtol=0, atol=0.01 * np.abs(expected.displacements).max())


def test_quadratic_elements_give_the_corners_of_the_mesh_and_move_further(cube: TetMesh) -> None:
    linear, quadratic = (simulate(replace(HELD, solver=Solver(element=element)), cube) for element in ("P1", "P2"))
    assert quadratic.displacements.shape == linear.displacements.shape
    assert quadratic.report["element"] == "P2"
    assert np.abs(quadratic.displacements).max() > 1.05 * np.abs(linear.displacements).max()  # linear tets are too stiff
    np.testing.assert_array_equal(quadratic.surface_vertices, cube.nodes[cube.surface_nodes] + quadratic.displacements[:, cube.surface_nodes])


def test_a_run_that_breaks_down_without_a_step_limit_does_not_speak_of_one(cube: TetMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Newmark, "energy", lambda *_: np.array([np.nan]))
    with pytest.raises(SimulationStopped, match=r"found a drift of nan; the last good frame is 0, t = 0 s. The step is 0.0004 s: lower solver.time_step"):
        simulate(replace(HELD, solver=Solver("newmark")), cube)


def test_a_run_that_overflows_within_a_frame_stops_and_keeps_the_rest_state(cube: TetMesh) -> None:
    compiled = plan(HELD, cube)
    over = replace(compiled, scene=replace(HELD, recording=Recording(duration=3 * limits_of(compiled).lumped * 1000, frames=2)), steps_per_frame=1000)
    with pytest.raises(PhysicsError, match="simulation stopped at step 1000.*every value must be finite.*the last good frame is 0, t = 0 s") as caught:
        run(over)
    assert isinstance(caught.value, SimulationStopped)
    assert len(caught.value.trajectory.times) == 1


def test_strains_outside_linear_elasticity_and_inverted_tets_are_said(cube: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics.simulate"):
        simulate(HELD, cube)
        assert caplog.messages == []
        trajectory = simulate(replace(HELD, effects={"foot": Pinned(), "push": replace(PUSH, pressure=2e4)}), cube)
    corners = (cube.nodes + trajectory.displacements)[:, cube.tets]
    inverted = np.flatnonzero((np.linalg.det(corners[:, :, 1:] - corners[:, :, :1]) <= 0).any(axis=1))
    messages = [record.message for record in caplog.records if record.name == "sdfnet.physics.simulate"]
    assert len(messages) == 2
    assert messages[0].startswith("outside linear elasticity: the displacement gradient reaches 1.9")
    assert messages[1].startswith(f"{len(inverted)} frames hold inverted tets, the first is frame {inverted[0]}")
    assert trajectory.report["frames_with_inverted_tets"] == len(inverted)


def limits_of(compiled: Plan) -> StepLimits:
    assert compiled.limits is not None
    return compiled.limits


def _frames(scene: Scene, count: int) -> Scene:
    """The same scene up to its first `count` frames."""
    interval = scene.recording.duration / (scene.recording.frames - 1)
    return replace(scene, recording=Recording(duration=interval * (count - 1), frames=count))


def test_a_load_beyond_all_sense_is_refused_with_its_size_and_the_cure(cube: TetMesh) -> None:
    message = r"by 2 diagonals .*, found .*from frame \d, t = .*Weaken the loads, which are \S+ of Young's modulus, or shorten recording\.duration"
    with pytest.raises(PhysicsError, match=message):
        simulate(replace(HELD, effects={"foot": Pinned(), "push": replace(PUSH, pressure=1e9)}), cube)


def test_a_solid_may_fly_many_diagonals_as_long_as_it_stays_a_solid(cube: TetMesh) -> None:
    trajectory = simulate(replace(HELD, effects={"throw": InitialMotion(velocity=(1000.0, 0.0, 0.0))}), cube)
    assert trajectory.displacements[-1, :, 0].min() > 10 * cube.diagonal
