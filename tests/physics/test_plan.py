"""What a scene is compiled into, the choice of the step, and every refusal and warning before it."""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from jaxtyping import Bool, Float64

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.history import History, pulse, ramp
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.effects.roles import AddsLoad, ConstrainsNodes, Load
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.elements import FiniteElements
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, duration, plan
from sdfnet.physics.regions import BoxRegion, HalfSpace
from sdfnet.physics.simulate import run
from sdfnet.physics.stability import StepLimits
from sdfnet.physics.vibration import natural_frequencies
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
FOOT = Pinned()
EVERYWHERE = Pinned(HalfSpace((0.0, 0.0, 9.0)), components=(True, False, False), boundary_only=False)
PUSH = PressurePoke(center=(0.5, 0.5, 1.0), radius=0.2, pressure=10.0)


@dataclass(frozen=True)
class Grip(ConstrainsNodes, AddsLoad):
    """As a user would write one: holds some nodes and pulls at others."""

    def fixed_components(self, elements: FiniteElements) -> Bool[np.ndarray, "nodes 3"]:
        return np.repeat(elements.nodes[:, :1] == 0, 3, axis=1)

    def load(self, model: ElasticModel) -> Load:
        return Load(np.where(model.mesh.nodes[:, :1] == 1, [1.0, 0.0, 0.0], 0.0))


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis)


def scene_of(**effects: Effect) -> Scene:
    return Scene(Geometry(), effects, recording=Recording(duration=0.05, frames=6))


def limits_of(compiled: Plan) -> StepLimits:
    assert compiled.limits is not None
    return compiled.limits


def test_constraints_are_united_and_loads_added(cube: TetMesh) -> None:
    compiled = plan(scene_of(foot=FOOT, push=PUSH, grip=Grip()), cube)
    np.testing.assert_array_equal(compiled.fixed, FOOT.fixed_components(compiled.model.elements) | Grip().fixed_components(compiled.model.elements))
    expected = PUSH.load(compiled.model).nodal_force + Grip().load(compiled.model).nodal_force
    np.testing.assert_array_equal(compiled.equation().constant_force[:, 0], expected[~compiled.fixed])
    assert compiled.report["push_loaded_area_m2"] == PUSH.load(compiled.model).report["loaded_area_m2"]


def test_auto_takes_the_fewest_steps_that_stay_within_safety_times_the_true_limit(cube: TetMesh) -> None:
    for mass in ("lumped", "consistent"):
        compiled = plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(mass=mass, safety=0.8)), cube)
        allowed = 0.8 * limits_of(compiled).of(mass)
        assert compiled.time_step <= allowed
        assert 0.01 / (compiled.steps_per_frame - 1) > allowed
        assert compiled.steps == 5 * compiled.steps_per_frame
        assert compiled.time_step * compiled.steps == pytest.approx(0.05, rel=1e-15)


def test_a_given_step_that_fills_the_interval_is_kept_and_nothing_is_logged(cube: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="sdfnet.physics.plan"):
        compiled = plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(time_step=1e-4)), cube)
    assert compiled.steps_per_frame == 100
    assert compiled.time_step == pytest.approx(1e-4, rel=1e-12)
    assert [record.message for record in caplog.records if record.name == "sdfnet.physics.plan"] == []


def test_a_given_step_is_shortened_to_a_whole_number_per_frame_and_that_is_said(cube: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="sdfnet.physics.plan"):
        compiled = plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(time_step=3e-4)), cube)
    assert compiled.steps_per_frame == 34
    assert "time step 0.0003 s shortened to 0.000294118 s, so that 34 of them fill the 0.01 s between two frames" in caplog.text


def test_a_step_over_the_true_limit_is_refused_with_both_numbers_and_the_cure(cube: TetMesh) -> None:
    limit = limits_of(plan(scene_of(foot=FOOT, push=PUSH), cube)).lumped
    message = f"time step {1.001 * limit:.4g} s exceeds the stable limit {limit:.4g} s of the lumped mass; lower solver.time_step or set it to auto"
    with pytest.raises(PhysicsError, match=f"^{message}$"):
        plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(time_step=1.001 * limit)), cube)
    assert plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(time_step=0.999 * limit)), cube).time_step < limit


def test_the_limit_that_counts_is_that_of_the_mass_in_use(cube: TetMesh) -> None:
    limits = limits_of(plan(scene_of(foot=FOOT, push=PUSH), cube))
    between = (limits.lumped + limits.consistent) / 2
    plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(time_step=between)), cube)
    with pytest.raises(PhysicsError, match="of the consistent mass"):
        plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(time_step=between, mass="consistent")), cube)


def test_damping_shortens_the_automatic_step_and_the_limit_of_a_given_one(cube: TetMesh) -> None:
    damped = scene_of(foot=FOOT, push=PUSH, damping=RayleighDamping(stiffness=1e-3))
    limits, plain = limits_of(plan(damped, cube)), limits_of(plan(scene_of(foot=FOOT, push=PUSH), cube))
    assert limits.lumped == plain.lumped
    assert limits.of("lumped") < 0.8 * plain.of("lumped")
    assert plan(damped, cube).time_step <= 0.9 * limits.of("lumped")
    with pytest.raises(PhysicsError, match=f"exceeds the stable limit {limits.of('lumped'):.4g} s of the lumped mass"):
        plan(replace(damped, solver=Solver(time_step=0.99 * plain.lumped)), cube)


def test_a_force_that_follows_the_state_shortens_the_step_by_its_stiffness(cube: TetMesh, on_springs: Callable[..., Effect]) -> None:
    stiff = limits_of(plan(scene_of(foot=FOOT, push=PUSH, springs=on_springs(share=0.5)), cube))
    assert stiff.lumped < 0.95 * limits_of(plan(scene_of(foot=FOOT, push=PUSH), cube)).lumped


@pytest.mark.parametrize(("integrator", "steps_per_frame"), [("newmark", 10), ("modal", 1), ("exact", 1)])
def test_methods_without_a_step_limit_take_a_part_of_a_frame(cube: TetMesh, integrator: str, steps_per_frame: int) -> None:
    scene = replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(integrator))
    assert plan(scene, cube).steps_per_frame == steps_per_frame
    assert plan(replace(scene, solver=Solver(integrator, time_step=0.005)), cube).steps_per_frame == 2  # as asked


BLOW = History((0.0101, 0.0102, 0.0103), (0.0, 1.0, 0.0))  # of a fifth of the automatic step
AT_ONCE = pulse(0.0, 1e-12)
APPROXIMATE = [name for name, kind in INTEGRATORS.items() if not kind.is_exact_in_time]
WITHIN_A_STEP = (
    r"the load 'push' over time changes within a step of .* s: lines between the steps miss it by up to \S+ % of its strength, and should by 10 % at most\. "
)


def pushed(history: History, solver: Solver) -> Scene:
    return replace(scene_of(foot=FOOT, push=replace(PUSH, history=history)), solver=solver)


@pytest.mark.parametrize("solver", [Solver(), Solver("symplectic_euler", mass="consistent"), Solver("newmark")])
def test_the_automatic_step_follows_a_short_blow_and_the_plan_says_why(cube: TetMesh, caplog: pytest.LogCaptureFixture, solver: Solver) -> None:
    constant = replace(scene_of(foot=FOOT, push=PUSH), solver=solver)
    compiled = plan(pushed(BLOW, solver), cube)
    assert BLOW.largest_miss(plan(constant, cube).time_step, 0.05) > 0.5
    assert BLOW.largest_miss(compiled.time_step, 0.05) <= 0.1
    assert BLOW.largest_miss(2 * compiled.time_step, 0.05) > 0.1
    assert ", so short to follow the load 'push' over time" in compiled.describe()
    assert "so short" not in plan(constant, cube).describe()
    as_case = replace(constant, effects={"foot": FOOT}, load_cases={"push": replace(PUSH, history=BLOW)})
    assert plan(as_case, cube).steps == compiled.steps
    assert caplog.messages == []


def test_a_load_over_time_that_the_automatic_step_follows_does_not_shorten_it(cube: TetMesh) -> None:
    constant, slow = scene_of(foot=FOOT, push=PUSH), replace(PUSH, history=pulse(0.0, 0.05))
    assert plan(scene_of(foot=FOOT, push=slow), cube).steps == plan(constant, cube).steps


@pytest.mark.parametrize("integrator", APPROXIMATE)
def test_a_load_too_short_for_any_bearable_step_leaves_the_step_and_is_warned_of(cube: TetMesh, caplog: pytest.LogCaptureFixture, integrator: str) -> None:
    constant = replace(scene_of(foot=FOOT, push=PUSH), solver=Solver(integrator))
    with caplog.at_level(logging.WARNING):
        compiled = plan(pushed(AT_ONCE, Solver(integrator)), cube)
    assert compiled.steps == plan(constant, cube).steps
    (message,) = caplog.messages
    assert re.match(WITHIN_A_STEP, message)


@pytest.mark.parametrize("integrator", APPROXIMATE)
@pytest.mark.parametrize("duration", [0.05, 0.5])
def test_a_given_step_that_passes_over_a_blow_stays_and_is_warned_of_with_the_cure(
    cube: TetMesh, caplog: pytest.LogCaptureFixture, integrator: str, duration: float
) -> None:
    scene = replace(pushed(BLOW, Solver(integrator, time_step=1e-3)), recording=Recording(duration, 6))
    with caplog.at_level(logging.WARNING):
        compiled = plan(scene, cube)
    assert compiled.time_step == pytest.approx(1e-3)
    (message,) = caplog.messages
    assert re.match(WITHIN_A_STEP + "Its impulse is kept, but comes up to a step early or late; set solver.time_step=", message)
    assert "within a step of 0.001 s: lines between the steps miss it by up to 1e+02 %" in message  # at the blow, however long the run
    cure = re.search(r"set solver.time_step=(\S+), or solver.integrator=exact, which follows any load$", message)
    assert cure is not None
    caplog.clear()
    plan(replace(scene, solver=replace(scene.solver, time_step=float(cure[1]))), cube)
    assert caplog.messages == []


def test_where_a_force_follows_the_state_the_cure_names_no_method_that_refuses_it(
    cube: TetMesh, caplog: pytest.LogCaptureFixture, on_springs: Callable[..., Effect]
) -> None:
    for history, cure in ((BLOW, r"set solver.time_step=\S+$"), (AT_ONCE, "give it a longer history if more than the impulse matters$")):
        scene = pushed(history, Solver(time_step=1e-3))
        plan(replace(scene, effects=scene.effects | {"springs": on_springs()}), cube)
        assert re.search(cure, caplog.messages[-1])
        assert "solver.integrator" not in caplog.text


@pytest.mark.parametrize(("mass", "damped"), [("lumped", False), ("lumped", True), ("consistent", False)])
def test_the_cure_names_a_method_that_takes_the_scene(cube: TetMesh, caplog: pytest.LogCaptureFixture, mass: str, damped: bool) -> None:
    scene = pushed(AT_ONCE, Solver(mass=mass))
    scene = replace(scene, effects=scene.effects | ({"damping": RayleighDamping(1.0)} if damped else {}))
    plan(scene, cube)
    needs_modal = damped or mass == "consistent"
    cure = "modal with all modes (solver.modes=144, for small meshes)" if needs_modal else "exact"
    assert caplog.messages[-1].endswith(f"; set solver.integrator={cure}, which follows any load")  # and no step: a run may not take so many
    caplog.clear()
    plan(replace(scene, solver=Solver("modal" if needs_modal else "exact", mass, modes=144)), cube).compile()
    assert caplog.messages == []


@pytest.mark.parametrize("integrator", ["modal", "exact"])
@pytest.mark.parametrize("history", [BLOW, AT_ONCE, ramp(1e-6)])
def test_methods_exact_in_time_follow_any_load_at_any_step(cube: TetMesh, caplog: pytest.LogCaptureFixture, integrator: str, history: History) -> None:
    assert plan(pushed(history, Solver(integrator)), cube).steps_per_frame == 1
    assert plan(pushed(history, Solver(integrator, time_step=1e-3)), cube).steps_per_frame == 10
    assert caplog.messages == []


def test_the_plan_says_what_a_step_computes(cube: TetMesh, on_springs: Callable[..., Effect]) -> None:
    effects = {"foot": FOOT, "push": replace(PUSH, history=ramp(0.01)), "damping": RayleighDamping(1.0, 1e-5), "springs": on_springs()}
    text = plan(scene_of(**effects), cube).describe()
    assert "leapfrog: a sparse product, 1 loads scaled over time, two scalings for damping, the force of springs" in text
    assert "push: PressurePoke adds a load over time from 0 to 0.01 s (loaded_area_m2 0.12" in text
    assert "damping: RayleighDamping damps with C = 1/s M + 1e-05 s K" in text
    assert "springs: OnSprings needs a new force at every step" in text
    implicit = plan(replace(scene_of(foot=FOOT, push=PUSH), solver=Solver("newmark", element="P2", mass="consistent")), cube).describe()
    assert "newmark: a sparse product, a solve with the factor of M + h/2 C + h^2/4 K" in implicit
    assert "P2 elements" in implicit
    assert "step limits" not in implicit
    assert "mass consistent" in implicit


def test_an_integrator_that_cannot_do_what_the_scene_needs_is_refused_before_the_first_step(cube: TetMesh) -> None:
    scene = replace(scene_of(foot=FOOT, push=PUSH, damping=RayleighDamping(1.0)), solver=Solver("exact"))
    with pytest.raises(ConfigurationError, match="solver.integrator=exact cannot integrate damping, which this scene has; set solver.integrator=leapfrog"):
        plan(scene, cube).compile()


def test_the_plan_can_be_read(cube: TetMesh) -> None:
    compiled = plan(scene_of(foot=FOOT, push=PUSH), cube)
    text = compiled.describe()
    assert "foot: Pinned fixes 48 components of 16 nodes" in text
    assert "push: PressurePoke adds a constant load (loaded_area_m2 0.12" in text
    assert "144 degrees of freedom free; mass lumped" in text
    assert f"{compiled.steps} steps, {compiled.steps_per_frame} per frame, 6 frames over 0.05 s" in text
    assert "the paper's CFL h_min/c" in text
    assert "s predicted for the steps" in text


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({"odd": Effect()}, "effect 'odd' .Effect. asks nothing of the simulator; derive it from a role"),
        ({"foot": FOOT, "poke": PressurePoke(center=(0.5, 0.5, 0.0), radius=0.1)}, "the load 'poke' must reach a node that is free to move"),
        (
            {"a": replace(EVERYWHERE, components=(True, True, False)), "b": replace(EVERYWHERE, components=(False, False, True))},
            "found every component of every node fixed; pin less",
        ),
    ],
)
def test_scenes_in_which_nothing_could_happen_are_refused(cube: TetMesh, effects: dict[str, Effect], message: str) -> None:
    with pytest.raises((ConfigurationError, PhysicsError), match=message):
        plan(Scene(Geometry(), effects), cube)


@pytest.mark.parametrize(
    ("effects", "material", "message"),
    [
        ({"push": PUSH}, Material(), "nothing holds the solid: it flies freely"),
        (
            {"foot": FOOT, "push": PUSH},
            Material(poisson_ratio=0.46),
            "linear tets lock and the solid will look too stiff; set solver.element=P1_nodal_pressure",
        ),
        ({"foot": FOOT, "push": replace(PUSH, pressure=4000.0)}, Material(), "the load is 0.8 of Young's modulus"),
        ({"foot": FOOT, "weight": BodyForce(density=(0.0, 0.0, -600.0))}, Material(), "the load is 0.21 of Young's modulus"),
    ],
)
def test_a_doubtful_scene_runs_with_one_warning(
    cube: TetMesh, caplog: pytest.LogCaptureFixture, effects: dict[str, Effect], material: Material, message: str
) -> None:
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics.plan"):
        plan(replace(scene_of(**effects), material=material), cube)
    assert len(caplog.messages) == 1
    assert message in caplog.messages[0]


def test_a_plan_without_a_load_says_so_where_it_is_printed_and_is_no_matter_to_modes(cube: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="sdfnet"):
        compiled = plan(scene_of(foot=FOOT), cube)
        natural_frequencies(compiled, 1)
        text = compiled.describe()
        assert caplog.messages == []
        run(compiled)
    assert caplog.messages == ["nothing loads the solid or moves it: every frame will be the rest state"]
    assert f"  {caplog.messages[0]}" in text.splitlines()
    assert "nothing loads" not in plan(scene_of(foot=FOOT, push=PUSH), cube).describe()


def beside_itself(mesh: TetMesh, count: int) -> TetMesh:
    """So many copies in a row, two widths apart, that share no node."""
    shift = 2 * np.ptp(mesh.nodes[:, 0]) * np.array([1.0, 0.0, 0.0])
    return TetMesh(np.concatenate([mesh.nodes + k * shift for k in range(count)]), np.concatenate([mesh.tets + k * len(mesh.nodes) for k in range(count)]))


LEFT_FOOT = Pinned(BoxRegion((-1.0, -1.0, -1.0), (1.5, 2.0, 0.01)))


def test_a_part_of_the_mesh_that_nothing_holds_is_named_with_the_cure(cube: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics.plan"):
        plan(scene_of(foot=LEFT_FOOT, push=PUSH), beside_itself(cube, 2))
        plan(scene_of(foot=LEFT_FOOT, push=PUSH), beside_itself(cube, 6))
    one, many = caplog.messages
    assert one == (
        f"1 of the 2 unconnected parts of the mesh is held by nothing, and any load makes it fly freely: part 2 of {len(cube.tets)} tets about "
        "(2.5, 0.5, 0.5) m; pin each by itself, join it to the rest, or leave it out of the mesh"
    )
    assert many.startswith("5 of the 6 unconnected parts of the mesh are held by nothing, and any load makes them fly freely, such as part 2 of ")
    assert many.count(f"of {len(cube.tets)} tets about") == 3


@pytest.mark.parametrize(
    "meant",
    [
        {"second_foot": FOOT},
        {"throw": InitialMotion(velocity=(0.0, 0.0, 1.0), region=HalfSpace((1.5, 0.0, 0.0), (-1.0, 0.0, 0.0)))},
        {"floor": FloorContact()},
    ],
)
def test_a_part_that_is_held_thrown_or_over_a_floor_is_no_doubt(cube: TetMesh, caplog: pytest.LogCaptureFixture, meant: dict[str, Effect]) -> None:
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics.plan"):
        plan(scene_of(foot=LEFT_FOOT, push=PUSH, **meant), beside_itself(cube, 2))
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("solver", "cure"),
    [
        (Solver(), "shorten recording.duration, set solver.integrator=newmark or modal, whose step is free, or mesh without the tet that governs the step"),
        (Solver("newmark", time_step=1e-9), "raise solver.time_step, set it to auto, or shorten recording.duration"),
    ],
)
def test_more_steps_than_anybody_waits_for_are_shown_and_refused_with_the_days_that_they_take(make_box: MakeBox, solver: Solver, cure: str) -> None:
    scene = replace(scene_of(foot=FOOT, push=PUSH), recording=Recording(duration=1e8, frames=3), solver=solver)
    compiled = plan(scene, make_box([0, 1], [0, 1], [0, 1]))
    assert compiled.steps > 1e9
    days = r"\S+ s \(\S+ days\)"
    assert re.search(rf"\n  {days} predicted for the steps\n  a run refuses more than 1e\+08 steps; {re.escape(cure)}$", compiled.describe())
    message = rf"^a run may take 1e\+08 steps, this one would take \S+ of \S+ s, about {days} of computing; {re.escape(cure)}$"
    with pytest.raises(PhysicsError, match=message):
        run(compiled)


@pytest.mark.parametrize(("seconds", "text"), [(1.0, "1 s"), (7300.0, "7.3e+03 s (2 hours)"), (1e6, "1e+06 s (12 days)")])
def test_a_long_time_is_told_in_hours_or_days(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(("element", "poisson_ratio", "warns"), [("P1_nodal_pressure", 0.4999, False), ("P2", 0.49, False), ("P2", 0.4995, True)])
def test_only_elements_that_lock_warn_of_it(make_box: MakeBox, caplog: pytest.LogCaptureFixture, element: str, poisson_ratio: float, warns: bool) -> None:
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics.plan"):
        plan(
            replace(scene_of(foot=FOOT, push=PUSH), material=Material(poisson_ratio=poisson_ratio), solver=Solver(element=element)),
            make_box([0, 1], [0, 1], [0, 1]),
        )
    assert ["quadratic tets lock" in message for message in caplog.messages] == ([True] if warns else [])
    assert not any("P1_nodal_pressure" in message for message in caplog.messages)  # in bending it is far worse than what it would cure


def test_an_absent_effect_is_never_called(cube: TetMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> Float64[np.ndarray, "nodes 3"]:
        raise AssertionError("called for a scene that has no body force")

    monkeypatch.setattr("sdfnet.physics.effects.body_force.body_force", refuse)
    plan(scene_of(foot=FOOT, push=PUSH), cube)
    with pytest.raises(AssertionError, match="called for a scene"):
        plan(scene_of(foot=FOOT, weight=BodyForce(density=(0.0, 0.0, -1.0))), cube)
