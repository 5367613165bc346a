"""What every effect promises, in one loop over the registry: a new one is tested by a line in SAMPLES."""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

import sdfnet.physics.effects
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import NodalForce, NodalStart
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.history import History, ramp
from sdfnet.physics.effects.inclusion import Inclusion
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.prestrain import Prestrain
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.effects.rigid_finger import RigidFinger
from sdfnet.physics.effects.roles import AddsDamping, AddsLoad, ChangesMaterial, ConstrainsNodes, FollowsState, ReplacesElasticity, SetsStart
from sdfnet.physics.effects.traction import Traction
from sdfnet.physics.elasticity import finite_elements
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import BoxRegion
from sdfnet.physics.simulate import run
from sdfnet.plugins import find_effects, frozen, writable
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
ROLES = (ChangesMaterial, ConstrainsNodes, AddsLoad, AddsDamping, SetsStart, FollowsState, ReplacesElasticity)
ALL_ELEMENTS = ("P1", "P1_nodal_pressure", "P2")
FOLDER = Path(str(sdfnet.physics.effects.__file__)).parent
SHARED = {"__init__.py", "arrays.py", "history.py", "roles.py"}  # what every scene goes through, and what these tests' own scene is made of
UNIT = re.compile(r"\bin (Pa|N|J|m|s|1/s|K)\b|= 0 m\b")


@dataclass(frozen=True)
class Sample:
    """An effect that does something to the cube below, the same with no magnitude where it has one, and its elements."""

    acting: Effect
    nothing: Effect | None
    elements: tuple[str, ...] = ALL_ELEMENTS


FALL, TOUCH, FINGER = ramp(0.01), PressurePoke((0.5, 0.5, 1.0), 0.3, 50.0), RigidFinger((0.5, 0.5, 1.25), 0.2, speed=20.0, travel=0.3)
SAMPLES = {
    "body_force": Sample(BodyForce((0.0, 30.0, 0.0)), BodyForce((0.0, 0.0, 0.0), FALL)),
    "finite_strain": Sample(FiniteStrain(), None, ("P1",)),
    "floor_contact": Sample(FloorContact(height=-0.005, stiffness_factor=1.0), FloorContact(stiffness_factor=0.0)),
    "gravity": Sample(Gravity(history=FALL), Gravity((0.0, 0.0, 0.0), FALL)),
    "inclusion": Sample(Inclusion(BoxRegion(lower=(0.5, 0.0, 0.0)), Material(5e4)), None, ("P1", "P2")),
    "initial_motion": Sample(InitialMotion((1.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 0.0), BoxRegion(upper=(0.5, 2.0, 2.0))), InitialMotion()),
    "pinned": Sample(Pinned(), None),
    "pressure_poke": Sample(replace(TOUCH, direction=(1.0, 0.0, 0.0), history=FALL), replace(TOUCH, pressure=0.0)),
    "prestrain": Sample(Prestrain((0.01, 0.0, 0.0, 0.0, 0.002, 0.0), 1e-4, 30.0), Prestrain(expansion_coefficient=1e-4)),
    "rayleigh_damping": Sample(RayleighDamping(20.0, 1e-4), RayleighDamping()),
    "rigid_finger": Sample(FINGER, replace(FINGER, stiffness_factor=0.0)),
    "traction": Sample(Traction(BoxRegion(lower=(1.0, 0.0, 0.0)), (0.0, 9.0, 0.0), 5.0), Traction(BoxRegion(lower=(1.0, 0.0, 0.0)))),
}
WITH_HISTORY = [name for name, sample in SAMPLES.items() if hasattr(sample.acting, "history")]
WITH_NOTHING = [name for name, sample in SAMPLES.items() if sample.nothing is not None]


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    return make_box([0, 0.5, 1], [0, 0.5, 1], [0, 0.5, 1])


def _scene(mesh: TetMesh, element: str, **effects: Effect) -> Scene:
    """A cube that flies downwards, shears and is pulled at, with these effects besides."""
    nodes = finite_elements(mesh, element).nodes
    start = NodalStart(velocity=np.stack([nodes[:, 2], 0 * nodes[:, 0], -3 - nodes[:, 1]], axis=1))
    pull = NodalForce(np.where(nodes[:, :1] == 1, [0.1, 0.0, 0.0], 0.0))
    return Scene(Geometry(), {"start": start, "pull": pull, **effects}, recording=Recording(0.01, 3), solver=Solver(element=element))


def _displacements(mesh: TetMesh, element: str, **effects: Effect) -> np.ndarray:
    found: np.ndarray = run(plan(_scene(mesh, element, **effects), mesh)).displacements
    return found


@pytest.fixture(scope="module")
def alone(cube: TetMesh) -> Callable[[str], np.ndarray]:
    """The displacements without an effect, by element."""
    return cache(lambda element: _displacements(cube, element))


def _calls(work: Callable[[], Any]) -> dict[str, int]:
    """How many functions of each file of the effects' folder were called."""
    counts: dict[str, int] = {}

    def count(frame: FrameType, event: str, _: object) -> None:
        folder, _, name = frame.f_code.co_filename.rpartition("/")  # by hand: a Path for every call takes ten times as long as the run
        if event == "call" and folder == str(FOLDER) and name not in SHARED:
            counts[name] = counts.get(name, 0) + 1

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(before)
    return counts


def test_every_effect_has_a_sample_here() -> None:
    found = find_effects([])
    assert set(SAMPLES) == set(found)
    assert {name: type(sample.acting) for name, sample in SAMPLES.items()} == found


@pytest.mark.parametrize(("name", "element"), [(name, element) for name, sample in SAMPLES.items() for element in sample.elements])
def test_an_effect_changes_the_motion_of_every_element(cube: TetMesh, alone: Callable[[str], np.ndarray], name: str, element: str) -> None:
    found = _displacements(cube, element, one=SAMPLES[name].acting)
    assert np.isfinite(found).all()
    assert np.abs(found - alone(element)).max() > 1e-6  # of a motion of 0.03 m


@pytest.mark.parametrize("element", ALL_ELEMENTS)
@pytest.mark.parametrize("name", WITH_NOTHING)
def test_an_effect_of_no_magnitude_leaves_every_bit_as_it_is(cube: TetMesh, alone: Callable[[str], np.ndarray], name: str, element: str) -> None:
    nothing = SAMPLES[name].nothing
    assert nothing is not None
    assert _displacements(cube, element, one=nothing).tobytes() == alone(element).tobytes()


@pytest.mark.parametrize("name", WITH_HISTORY)
def test_a_history_of_nothing_leaves_every_bit_as_it_is(cube: TetMesh, alone: Callable[[str], np.ndarray], name: str) -> None:
    never: Any = replace(SAMPLES[name].acting, history=History((0.0, 0.005), (0.0, 0.0)))  # type: ignore[call-arg]
    assert list(plan(_scene(cube, "P1", one=never), cube).demands.loads) == ["pull"]
    assert _displacements(cube, "P1", one=never).tobytes() == alone("P1").tobytes()


@pytest.mark.parametrize("name", WITH_HISTORY)
def test_a_constant_factor_scales_the_load(cube: TetMesh, alone: Callable[[str], np.ndarray], name: str) -> None:
    once, twice = (replace(SAMPLES[name].acting, history=History((0.0,), (factor,))) for factor in (1.0, 2.0))  # type: ignore[call-arg]
    before, first, second = alone("P1"), _displacements(cube, "P1", one=once), _displacements(cube, "P1", one=twice)
    np.testing.assert_allclose(second - before, 2 * (first - before), atol=1e-13)


@pytest.mark.parametrize("name", WITH_NOTHING)
def test_an_effect_of_no_magnitude_adds_nothing_to_the_equation_of_motion(cube: TetMesh, name: str) -> None:
    nothing = SAMPLES[name].nothing
    assert nothing is not None
    compiled = plan(_scene(cube, "P1", one=nothing), cube)
    motion, alone = compiled.equation(), plan(_scene(cube, "P1"), cube).equation()
    assert list(compiled.demands.loads) == ["pull"]
    assert (motion.laws, motion.timed_loads, bool(motion.damping)) == ((), (), False)
    assert motion.constant_force.tobytes() == alone.constant_force.tobytes()
    assert motion.velocity.tobytes() == alone.velocity.tobytes()


def test_of_absent_effects_no_function_is_called_and_nothing_is_there(cube: TetMesh) -> None:
    assert _calls(lambda: _displacements(cube, "P1")) == {}
    integrator, _ = plan(_scene(cube, "P1"), cube).compile()
    motion, state = integrator.motion, integrator.initial_state()
    assert (motion.laws, motion.timed_loads, bool(motion.damping), state.work, state.own) == ((), (), False, {}, {})


@pytest.mark.parametrize("name", SAMPLES)
def test_of_a_present_effect_functions_are_called_and_of_no_other(cube: TetMesh, name: str) -> None:
    called = _calls(lambda: _displacements(cube, "P1", one=SAMPLES[name].acting))
    assert f"{name}.py" in called
    assert not {f"{other}.py" for other in SAMPLES if other != name} & set(called)


@pytest.mark.parametrize("name", SAMPLES)
def test_an_effect_is_a_frozen_dataclass_that_compares_its_fields_and_has_a_role(name: str) -> None:
    kind = type(SAMPLES[name].acting)
    assert is_dataclass(kind)
    assert "__dataclass_params__" in vars(kind)
    assert vars(kind)["__dataclass_params__"].frozen
    assert vars(kind)["__dataclass_params__"].eq  # or all of a kind are equal, as their base without fields is
    assert issubclass(kind, ROLES)


@pytest.mark.parametrize("name", SAMPLES)
def test_the_docstring_gives_an_equation_units_who_needs_it_and_who_does_not(name: str) -> None:
    text = str(type(SAMPLES[name].acting).__doc__)
    for promised in (r" [=<>] | <= ", UNIT, r"\bFor\b", r"\b(Not|not)\b"):
        assert re.search(promised, text), promised


@pytest.mark.parametrize("name", SAMPLES)
def test_an_effect_survives_the_way_through_a_configuration_file(name: str) -> None:
    acting = SAMPLES[name].acting
    assert frozen(writable(acting)) == acting
    page = OmegaConf.create(OmegaConf.to_yaml(writable(acting)))
    assert frozen(OmegaConf.merge(writable(type(acting)), page)) == acting  # type: ignore[arg-type]
