"""What a user hands over from Python: taken where the declared type holds it, refused in words where not."""

import importlib
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from jaxtyping import Complex128, Float, Float64, Shaped, UInt8

from sdfnet.checked import Checked, taken
from sdfnet.data.settings import BatchSettings
from sdfnet.errors import ConfigurationError
from sdfnet.geometry.solids import Box, ClosedSurface, Sphere
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import FixedComponents, NodalForce, NodalStart
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.history import History, ramp
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.roles import AddsDamping, Damping
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import HalfSpace, Where
from sdfnet.physics.statics import require_linear
from sdfnet.plugins import find_effects
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver
from sdfnet.training.settings import TrainingSettings

Kinds = list[type[Checked]]
ONE = np.array([[0, 1, 2, 3]])
CORNERS = np.vstack([np.zeros(3), np.eye(3)])


def made(kind: type, *values: Any, **named: Any) -> Any:
    """An instance as a user makes it: without the check of types that is switched on for the tests alone."""
    instance: Any = object.__new__(kind)
    inspect.unwrap(vars(kind)["__init__"])(instance, *values, **named)
    return instance


def _derived(kind: type[Checked]) -> Kinds:
    return [one for derived in kind.__subclasses__() for one in (derived, *_derived(derived))]


find_effects([])  # with these two everything that a user fills in is loaded
importlib.import_module("sdfnet.cli.settings")
ALL = [kind for kind in dict.fromkeys(_derived(Checked)) if kind.__module__.startswith("sdfnet.") and not inspect.isabstract(kind) and fields(kind)]  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ALL, ids=lambda kind: kind.__name__)
def test_whatever_is_filled_in_refuses_a_foreign_object_by_class_and_field(kind: type[Checked]) -> None:
    entry = next(entry for entry in fields(kind) if entry.init)  # type: ignore[arg-type]
    values = {one.name: object() for one in fields(kind) if one.init}  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=rf"^{kind.__name__}\.{entry.name} must be .*, found <object objec"):
        made(kind, **values)


def test_the_settings_of_every_stage_are_among_them() -> None:
    assert {Material, Scene, Gravity, FixedComponents, HalfSpace, History, TetMesh, Surface, BatchSettings, TrainingSettings} <= set(ALL)


@pytest.mark.parametrize(
    "triple", [[0, 0, -9.81], np.array([0, 0, -9.81]), torch.tensor([0, 0, -9.81], dtype=torch.float64), (0, np.float32(0), -9.81)], ids=repr
)
def test_three_numbers_are_taken_in_every_form_and_are_the_same_effect(triple: Any) -> None:
    found = made(Gravity, triple)
    assert found == Gravity((0.0, 0.0, -9.81))
    assert repr(found) == repr(Gravity((0.0, 0.0, -9.81)))  # by which prepared files and snapshots are named


def test_whole_numbers_are_numbers_and_numbers_may_be_whole() -> None:
    material = made(Material, 5000, np.float64(0.25), torch.tensor(3))
    assert repr(material) == repr(Material(5000.0, 0.25, 3.0))
    assert repr(made(Recording, 1, 5.0)) == repr(Recording(1.0, 5))
    assert repr(made(Solver, time_step=1)) == repr(Solver(time_step=1.0))
    assert repr(made(Pinned, components=np.array([1, 1, 0]))) == repr(Pinned(components=(True, True, False)))
    assert made(ClosedSurface, Path("a.obj")).path == "a.obj"
    assert made(ClosedSurface, x_extent=None).x_extent is None
    assert made(History, np.array([0, 1]), [0, 2]) == History((0.0, 1.0), (0.0, 2.0))


def test_a_mapping_is_a_dict_of_its_own() -> None:
    effects: dict[str, Effect] = {"weight": Gravity()}
    scene = Scene(Geometry(), effects)
    effects.clear()
    assert list(scene.effects) == ["weight"]


@pytest.mark.parametrize(
    "form", [np.asarray, np.ndarray.tolist, torch.as_tensor, np.float32, np.asfortranarray], ids=["array", "list", "tensor", "float32", "columns"]
)
def test_a_mesh_is_the_same_in_every_form(form: Callable[[np.ndarray], Any]) -> None:
    assert made(TetMesh, form(CORNERS), form(ONE)).digest == TetMesh(CORNERS, ONE).digest
    surface = made(Surface, form(CORNERS), form(ONE[:, :3]))
    assert (surface.vertices.dtype, surface.faces.dtype) == (np.float64, np.int64)


def test_an_array_that_fits_is_not_copied() -> None:
    force = np.ones((4, 3))
    assert NodalForce(force).force is force


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (Float[np.ndarray, "nodes 3"], "(nodes, 3) of type Float"),
        (Shaped[np.ndarray, "nodes 3"], "(nodes, 3) of type Shaped"),
        (Float64[np.ndarray, "*tets 3"], "(*tets, 3) of numbers"),
        (Float64[np.ndarray, "... 3"], "(..., 3) of numbers"),
    ],
)
def test_an_array_is_taken_as_jaxtyping_takes_it(hint: Any, words: str) -> None:
    right = np.ones((4, 3))
    assert taken("it", right, hint) is right
    with pytest.raises(ConfigurationError, match=re.escape(f"it must be an array {words}, found an array (4, 2) of float64")):
        taken("it", right[:, :2], hint)


def test_an_array_is_converted_where_one_dtype_is_declared() -> None:
    assert taken("it", [0.0, 255.0], UInt8[np.ndarray, " colours"]).tolist() == [0, 255]
    with pytest.raises(ConfigurationError, match=r"it must be an array \(colours\) of whole numbers, found an array \(1,\) of int64, -1 among them"):
        taken("it", [-1], UInt8[np.ndarray, " colours"])
    with pytest.raises(ConfigurationError, match=r"it must be an array \(waves\) of type Complex128, found an array \(1,\) of float64"):
        taken("it", [1.0], Complex128[np.ndarray, " waves"])


@pytest.mark.parametrize("mask", [np.eye(3, dtype=np.int32), np.eye(3).astype(bool).tolist(), torch.eye(3, dtype=torch.uint8)], ids=["ints", "lists", "bytes"])
def test_a_mask_of_zeros_and_ones_is_one(mask: Any) -> None:
    np.testing.assert_array_equal(made(FixedComponents, mask).mask, np.eye(3, dtype=np.bool_))


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (Material, {"youngs_modulus": "5e3"}, "Material.youngs_modulus must be a number (Pa), found '5e3'; write for example youngs_modulus=5000.0"),
        (Material, {"density": True}, "Material.density must be a number (kg/m^3), found True; write for example density=1.0"),
        (Material, {"density": 10**400}, "0000: int too large to convert to float; write for example density=1.0"),
        (Gravity, {"acceleration": b"abc"}, "Gravity.acceleration must be 3 numbers (m/s^2), found b'abc'; write"),
        (Gravity, {"acceleration": -9.81}, "Gravity.acceleration must be 3 numbers (m/s^2), found -9.81; write for example acceleration=(0.0, 0.0, -9.81)"),
        (Gravity, {"acceleration": (0.0, -9.81)}, "Gravity.acceleration must be 3 numbers (m/s^2), found (0.0, -9.81); write"),
        (Gravity, {"history": ramp}, "Gravity.history must be a History (the factor on the acceleration over time), found the function ramp"),
        (PressurePoke, {"center": "nose"}, "PressurePoke.center must be 3 numbers (m, on the surface), found 'nose'; write for example center=(0.0, 0.0, 0.0)"),
        (PressurePoke, {"center": (0, 0, 0), "direction": 1}, "PressurePoke.direction must be 3 numbers or None (of the push; "),
        (Pinned, {"region": abs}, "Pinned.region must be a Region (HalfSpace, BoxRegion, Ball, Where), found the function abs"),
        (Pinned, {"region": HalfSpace}, "found the class HalfSpace, of which nothing is made yet (write HalfSpace(...))"),
        (Pinned, {"components": "xy"}, "Pinned.components must be 3 values true or false (which of x, y, z are held), found 'xy'; write"),
        (Pinned, {"components": (2, 1, 0)}, "found (2, 1, 0)"),
        (Where, {"predicate": 3}, "Where.predicate must be a function, found 3"),
        (Scene, {"geometry": Geometry(), "effects": [Gravity()]}, "Scene.effects must be a dict of names, each with an Effect, found [Gravity("),
        (Scene, {"geometry": Geometry(), "effects": {"a": Gravity}}, "Scene.effects['a'] must be an Effect, found the class Gravity, of which nothing is made"),
        (Scene, {"geometry": TetMesh(CORNERS, ONE), "effects": {}}, "Scene.geometry must be a Geometry, found TetMesh("),
        (Recording, {"frames": 5.5}, "Recording.frames must be a whole number, found 5.5; write for example frames=101"),
        (Recording, {"frames": np.nan}, "Recording.frames must be a whole number, found nan"),
        (Solver, {"time_step": None}, "Solver.time_step must be a number or text (s; auto: the true stability limit times safety, "),
        (Box, {"cells": 4}, "Box.cells must be 3 whole numbers (along x, y and z), found 4; write for example cells=(4, 4, 4)"),
        (Sphere, {"cells": 2.5}, "Sphere.cells must be a whole number (along a diameter), found 2.5"),
        (History, {"times": 0.1}, "History.times must be a tuple of numbers (s, rising), found 0.1; write for example times=(0.0,)"),
        (TetMesh, {"nodes": CORNERS, "tets": np.hstack([ONE, ONE])}, "TetMesh.tets must be an array (tets, 4) of whole numbers, found an array (1, 8) of"),
        (TetMesh, {"nodes": CORNERS, "tets": ONE + 0.5}, "found an array (1, 4) of float64, 0.5 among them"),
        (TetMesh, {"nodes": CORNERS, "tets": ONE * np.nan}, "of float64, nan among them"),
        (TetMesh, {"nodes": CORNERS[:, :2].tolist(), "tets": ONE}, "TetMesh.nodes must be an array (nodes, 3) of numbers (m), found an array (4, 2) of"),
        (FixedComponents, {"mask": np.array([3, 5])}, "FixedComponents.mask must be an array (nodes, 3) of true and false, found an array (2,) of int64"),
        (FixedComponents, {"mask": 2 * np.eye(3, dtype=int)}, "of int64, 2 among them"),
        (NodalForce, {"force": CORNERS > 0}, "NodalForce.force must be an array (nodes, 3) of numbers (N), found an array (4, 3) of bool"),
        (NodalForce, {"force": [[1.0, 2.0], [3.0]]}, "NodalForce.force must be an array (nodes, 3) of numbers (N), found a list of 2: "),
        (NodalForce, {"force": torch.ones(4, 3, requires_grad=True)}, "array (4, 3) of torch.float32: Can't call numpy() on Tensor that requires grad"),
        (NodalStart, {"velocity": 3}, "NodalStart.velocity must be an array (nodes, 3) of numbers or None (m/s), found 3"),
        (BatchSettings, {"points_per_step": "many"}, "BatchSettings.points_per_step must be a whole number or None (drawn at random and shared"),
        (TrainingSettings, {"cycle": ("both",)}, "TrainingSettings.cycle must be a tuple of values, each a Phase, found ('both',)"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_with_unit_and_example(kind: type, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        made(kind, **values)
    assert message in str(caught.value)


@dataclass(frozen=True)
class Magnet(AddsDamping):
    """An effect of somebody else, with types that sdfnet has no word for."""

    names: list[str]
    poles: int = 2  # of the magnet
    anything: Any = None
    modes: tuple[Literal["on", "off"], ...] = ()

    def damping(self, model: ElasticModel) -> Damping:
        return Damping(1.0)


def test_an_effect_of_ones_own_is_checked_too_and_types_without_a_word_are_let_through() -> None:
    assert Magnet(["a"], anything=object).poles == 2
    with pytest.raises(ConfigurationError, match=r"Magnet\.poles must be a whole number \(of the magnet\), found 'two'; write for example poles=2"):
        Magnet(["a"], poles="two")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=r"Magnet\.modes must be a tuple of values, each typing\.Literal\['on', 'off'\], found 3; write"):
        Magnet(["a"], modes=3)  # type: ignore[arg-type]


def test_what_is_typed_at_a_prompt_has_no_source_and_is_refused_without_the_unit() -> None:
    names: dict[str, Any] = {"Checked": Checked, "dataclass": dataclass}
    exec("@dataclass\nclass Typed(Checked):\n    size: float  # m\n", names)
    with pytest.raises(ConfigurationError, match=r"^Typed\.size must be a number, found '1'; write for example size=0.0$"):
        names["Typed"]("1")


def test_a_plan_wants_a_scene_and_a_mesh_and_a_solution_wants_a_plan() -> None:
    scene, mesh = Scene(Geometry(), {"weight": Gravity()}), TetMesh(CORNERS, ONE)
    with pytest.raises(ConfigurationError, match=r"the scene must be a Scene, found TetMesh\("):
        inspect.unwrap(plan)(mesh, scene)
    with pytest.raises(ConfigurationError, match=r"the mesh, which for example Sphere\(\).tet_mesh\(\) makes, must be a TetMesh, found Box\("):
        inspect.unwrap(plan)(scene, Box())
    with pytest.raises(ConfigurationError, match=r"what is solved, which plan\(scene, mesh\) makes, must be a Plan, found Scene\("):
        inspect.unwrap(require_linear)(scene, "a static solution")
