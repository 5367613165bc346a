"""A rigid ball pushes where it overlaps the surface, as Hertz says, and does the work that the solid gains."""

import logging
import math
import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.rigid_finger import RigidFinger
from sdfnet.physics.effects.sphere_contact import SphereContact
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.energies import energies
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.simulate import SimulationStopped, run
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene

MakeBox = Callable[..., TetMesh]
FINGER = RigidFinger(center=(0.45, 0.55, 1.22), radius=0.2, speed=10.0, travel=0.1)


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis)


def _law(model: ElasticModel, finger: RigidFinger) -> SphereContact:
    law = finger.force_law(model, np.zeros(model.elements.nodes.shape, dtype=np.bool_))
    assert isinstance(law, SphereContact)
    return law


def _at_rest(model: ElasticModel) -> torch.Tensor:
    return torch.zeros(len(model.elements.nodes), 3, dtype=torch.float64)


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("place", [(0.5, 0.5), (1 / 3, 1 / 3), (0.61, 0.42)])
def test_a_ball_smaller_than_a_face_is_felt_the_same_wherever_it_lands(cube: TetMesh, element: str, place: tuple[float, float]) -> None:
    """On a flat face: the integral of k (R - |r|) n over the disc where the ball is under it; the faces' edges are 1/3 m and more."""
    model, radius, depth = assemble(cube, Material(), element), 0.05, 0.01
    law = _law(model, RigidFinger((*place, 1 + 2 * radius), radius, speed=1.0, travel=1.0, stiffness_factor=7.0))
    edge = (2 + math.sqrt(2)) / 9
    modulus = model.material.lame_lambda + 2 * model.material.lame_mu
    height, rim = radius - depth, math.sqrt(radius**2 - (radius - depth) ** 2)
    across = np.linspace(0, rim, 2001)
    distance = np.hypot(across, height)
    exact = float(-7.0 * modulus / edge * np.trapezoid((radius - distance) * height / distance * 2 * np.pi * across, across))
    force = law.force(_at_rest(model), radius + depth)
    np.testing.assert_allclose(force.sum(dim=0), [0, 0, exact], atol=0.03 * abs(exact))  # some thirty points are in the disc
    center = (force[:, 2] @ torch.from_numpy(model.elements.nodes)) / force[:, 2].sum()
    np.testing.assert_allclose(center[:2], place, atol=0.05 * rim)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_force_is_minus_the_gradient_of_the_stored_energy(cube: TetMesh, element: str) -> None:
    model = assemble(cube, Material(), element)
    law, generator = _law(model, FINGER), torch.Generator().manual_seed(4)
    displacement, change = (scale * torch.randn(len(model.elements.nodes), 3, generator=generator, dtype=torch.float64) for scale in (0.02, 1e-6))
    slope = (law.stored_energy(displacement + change, 1.0) - law.stored_energy(displacement - change, 1.0)) / 2
    work = float((law.force(displacement, 1.0) * change).sum())
    assert abs(work) > 0
    assert slope == pytest.approx(-work, rel=1e-5)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_added_stiffness_is_never_below_the_contact_tangent(cube: TetMesh, element: str) -> None:
    model = assemble(cube, Material(), element)
    law, random = _law(model, replace(FINGER, radius=3.0, center=(0.5, 0.5, 4.05))), np.random.default_rng(6)
    bound = law.added_stiffness()
    assert not bound[~model.elements.is_on_boundary].any()
    for _ in range(5):
        vector = random.standard_normal((len(bound), 3)) * model.elements.is_on_boundary[:, None]
        for _ in range(10):  # power iteration towards the largest tangent over bound
            ends = [law.force(torch.from_numpy(sign * 1e-6 * vector), 1.0).numpy().copy() for sign in (-1, 1)]
            ratio = np.vdot(vector, ends[0] - ends[1]) / 2e-6 / (bound[:, None] * vector**2).sum()
            assert ratio <= 1
            vector = np.divide(ends[0] - ends[1], bound[:, None], out=np.zeros_like(vector), where=bound[:, None] > 0)
            vector /= np.abs(vector).max()
    assert ratio > 0.3


def test_faces_out_of_reach_are_passed_over_without_a_difference(cube: TetMesh) -> None:
    model, random = assemble(cube, Material()), np.random.default_rng(8)
    along = replace(FINGER, center=(-0.3, 0.5, 1.1), direction=(1.0, 0.0, 0.0), travel=1.6, speed=80.0)
    law, touched = _law(model, along), 0
    displacement = np.zeros_like(cube.nodes)
    for time in np.linspace(0.0, 0.02, 40):
        displacement += 0.01 * random.standard_normal(displacement.shape)
        found = law.force(torch.from_numpy(displacement), float(time))
        fresh = _law(model, along)
        fresh._reach = 100.0  # every face is near
        expected = fresh.force(torch.from_numpy(displacement), float(time))
        touched += bool(expected.any())
        assert torch.equal(found, expected)
    assert 10 < touched < 40


def _scene(finger: RigidFinger, duration: float, frames: int, **effects: Effect) -> Scene:
    return Scene(Geometry(), {"foot": Pinned(), "finger": finger, **effects}, recording=Recording(duration, frames))


def test_before_the_touch_nothing_moves_and_the_report_is_of_what_was_touched(cube: TetMesh) -> None:
    trajectory = run(plan(_scene(FINGER, 0.02, 21), cube))
    moved = np.abs(trajectory.displacements).max(axis=(1, 2)) > 0
    np.testing.assert_array_equal(moved, trajectory.times > 0.002 + 1e-12)  # 2 cm at 10 m/s
    report = trajectory.report
    assert report["finger_frames_in_contact"] == 18
    assert 0.05 < float(report["finger_largest_indentation_m"]) < 0.08
    assert 0.08 < float(report["finger_largest_indentation_m"]) + float(report["finger_largest_penetration_m"]) < 0.11  # the solid swings on
    assert 0 < float(report["finger_largest_contact_area_m2"]) < math.pi * 2 * 0.2 * 0.08
    assert float(report["finger_largest_force_N"]) > 0


def test_what_the_finger_puts_in_is_what_the_solid_gains(cube: TetMesh) -> None:
    compiled = plan(_scene(FINGER, 0.03, 31), cube)
    integrator, watch = compiled.compile()
    state, gains, puts = integrator.initial_state(), [], []
    for _ in range(30):
        assert watch.problem(state) is None
        integrator.advance(state, compiled.steps_per_frame)
        middle = integrator.motion.nodal(state.displacement - 0.5 * integrator.time_step * state.velocity).numpy()
        velocity = integrator.motion.nodal(state.velocity).numpy()
        gains.append(energies(compiled, middle, velocity, (state.step - 0.5) * integrator.time_step).total)
        puts.append(float(state.work["drives"]))
    np.testing.assert_allclose(gains, puts, atol=0.02 * puts[-1])
    assert puts[-1] > 1
    assert puts[-1] == puts[12]  # it stands from 0.01 s on
    assert watch.law_error < 0.02


def _pressed(share: float, steps: int, cube: TetMesh) -> Plan:
    """A ball so large that it soon touches all of the top, where the step limit counts it, with a step that is a share of that limit; a hundred frames."""
    compiled = plan(_scene(RigidFinger((0.5, 0.5, 21.001), 20.0, speed=3.0, travel=0.05), 1.0, 2), cube)
    assert compiled.limits is not None
    recording = Recording(share * compiled.limits.of("lumped") * steps, 101)
    return replace(compiled, scene=replace(compiled.scene, recording=recording), steps_per_frame=steps // 100)


@pytest.mark.parametrize("steps", [1000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_one_percent_under_the_limit_stays_stable_in_contact(cube: TetMesh, steps: int) -> None:
    trajectory = run(_pressed(0.99, steps, cube))
    assert int(trajectory.report["finger_frames_in_contact"]) > 50
    assert float(trajectory.report["energy_drift"]) < 1e-10


def test_a_step_of_one_and_a_half_times_the_limit_is_caught(cube: TetMesh) -> None:
    with pytest.raises(SimulationStopped, match="force laws must keep their energy to"):
        run(_pressed(1.5, 1000, cube))


def test_a_run_goes_on_from_a_snapshot_in_contact_bit_for_bit(cube: TetMesh) -> None:
    compiled, kept = plan(_scene(FINGER, 0.008, 9), cube), []
    whole = run(compiled, keep=lambda snapshot: kept.append(deepcopy(snapshot)))
    again = replace(compiled, demands=plan(compiled.scene, cube).demands)  # a law that has not looked for near faces yet
    np.testing.assert_array_equal(run(again, resume=kept[4]).displacements, whole.displacements)


@pytest.mark.parametrize(("center", "overlap"), [((0.5, 0.5, 1.1), 0.1), ((0.5, 0.5, 0.5), 0.7), ((1.1, 1.1, 1.1), 0.2 - 0.1 * math.sqrt(3))])
def test_a_finger_that_starts_in_the_solid_is_refused_with_the_overlap(cube: TetMesh, center: tuple[float, float, float], overlap: float) -> None:
    with pytest.raises(PhysicsError, match=rf"start clear of the solid, found it {overlap:.4g} m deep in it at .*; move finger.center back"):
        _law(assemble(cube, Material()), replace(FINGER, center=center))


def test_a_finger_too_small_for_the_faces_is_refused(cube: TetMesh) -> None:
    with pytest.raises(PhysicsError, match="radius must be at least 0.125 of the faces' edges, found 0.01 m on edges up to 0.379 m; enlarge finger.radius"):
        _law(assemble(cube, Material()), replace(FINGER, radius=0.01))


def test_a_way_past_the_solid_is_warned_of_and_a_standing_finger_is_not(cube: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    model = assemble(cube, Material())
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics.effects"):
        _law(model, replace(FINGER, travel=0.05))
        _law(model, replace(FINGER, travel=0.0))
        assert not caplog.messages
        _law(model, replace(FINGER, travel=0.01))
    assert len(caplog.messages) == 1
    assert re.match("the finger's way passes the solid at rest by 0.01.* m: it touches only what moves into it; turn finger.direction", caplog.messages[0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": 0.0}, "finger.radius must be positive and finite, found 0.0 m"),
        ({"speed": -1.0}, "finger.speed must be finite and not negative, found -1.0 m/s; turn finger.direction round"),
        ({"travel": math.inf}, "finger.travel must be finite and not negative"),
        ({"direction": (0.0, 0.0, 0.0)}, "finger.direction must be finite and not zero"),
        ({"stiffness_factor": -2.0}, "finger.stiffness_factor must be finite and not negative"),
        ({"center": (0.0, math.nan, 0.0)}, "finger.center must be finite"),
    ],
)
def test_meaningless_settings_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        replace(FINGER, **settings)  # type: ignore[arg-type]
