"""An effect is one class in one file, found by its name and added to any scene on the command line."""

import importlib.metadata
import inspect
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra

import sdfnet.cli
import sdfnet.physics.effects
from sdfnet.cli.entry import register
from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.regions import Ball, BoxRegion, HalfSpace, Region
from sdfnet.plugins import find_datasets, find_effects, find_kinds, frozen, register_datasets, register_effects, shipped
from sdfnet.scene import Effect, Scene

EFFECT = '''
from dataclasses import dataclass

import numpy as np

from sdfnet.physics.effects.arrays import NodalForce
from sdfnet.physics.effects.roles import AddsLoad, Load


class Blowing(AddsLoad):
    """Abstract: it says no load."""


@dataclass(frozen=True)
class _Draught(AddsLoad):
    """Private."""

    def load(self, model): ...


@dataclass(frozen=True)
class SideWind(Blowing):
    """A force in N on every node."""

    force: float = 1e-4  # N

    def load(self, model):
        return Load(np.full_like(model.elements.nodes, self.force) * [1, 0, 0], report={"strength_N": self.force})
'''
SCENE = (
    EFFECT
    + '''
from sdfnet.geometry.solids import Sphere
from sdfnet.plugins import dataset
from sdfnet.scene import Dataset, Scene


@dataset
def kite() -> Dataset:
    """A ball in the wind."""
    return Dataset(Scene(Sphere(cells=2), {"wind": SideWind()}))
'''
)
REGION = '''

from sdfnet.physics.regions import Region


@dataclass(frozen=True)
class Slab(Region):
    """Over a height."""

    height: float = 0.0  # m

    def contains(self, points, tolerance=0.0):
        return points[:, 2] > self.height
'''
README = (Path(__file__).parents[1] / "README.md").read_text()
Command = Callable[..., str]
SMALL = ["dataset=sphere_squeeze", "dataset.scene.geometry.cells=3", "dataset.scene.effects.left.radius=0.03", "dataset.scene.effects.right.radius=0.03"]


@pytest.fixture(autouse=True)
def _clean_store(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers and loads is gone after it."""
    store = ConfigStore.instance()
    monkeypatch.setattr(store, "repo", {key: value for key, value in store.repo.items() if key not in ("dataset", "effect")})
    loaded = set(sys.modules)
    yield
    for name in set(sys.modules) - loaded:
        if name.startswith(("sdfnet_dataset_plugins", "windy")):
            del sys.modules[name]
    GlobalHydra.instance().clear()


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of somebody else as pip would have installed it: a module, and what it says of itself."""
    folder = tmp_path / "site-packages"
    about = folder / "windy-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: windy\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[sdfnet.effects]\nside_wind = windy_effects\n")
    (folder / "windy_effects.py").write_text(EFFECT)
    monkeypatch.syspath_prepend(str(folder))
    return folder


@pytest.fixture
def plugin() -> Path:
    """A folder with a dataset plugin that brings an effect."""
    Path("datasets").mkdir()
    Path("datasets/kite.py").write_text(SCENE)
    return Path("datasets")


@pytest.fixture
def prepare(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """All that `python prepare.py` says to these arguments."""

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["prepare.py", *arguments, "data_folder=data", "plan_only=true"])
        try:
            sdfnet.cli.prepare()
        except SystemExit as stop:
            return "".join([*capfd.readouterr(), str(stop.code)])
        return "".join(capfd.readouterr())

    return run


def _scene(*overrides: str) -> Scene:
    register("prepare")
    with initialize_config_dir(str(shipped("conf").resolve()), version_base="1.3"):
        found: Scene = frozen(compose("prepare", list(overrides))).dataset.scene
    return found


def test_each_effect_of_sdfnet_is_found_and_none_that_is_built_from_arrays() -> None:
    names = [path.stem for path in Path(str(sdfnet.physics.effects.__file__)).parent.glob("*.py") if path.stem != "arrays"]
    modules = [importlib.import_module(f"sdfnet.physics.effects.{name}") for name in names]
    kinds = {kind for module in modules for kind in vars(module).values() if inspect.isclass(kind) and issubclass(kind, Effect) and kind is not Effect}
    found = find_effects([])
    assert {kind for kind in kinds if not inspect.isabstract(kind)} == set(found.values())  # or pyproject.toml lacks one, or wants to be installed again
    assert found["gravity"] is Gravity
    assert not {"fixed_components", "nodal_force", "nodal_start"} & set(found)


def test_an_effect_joins_a_scene_on_the_command_line_with_its_fields() -> None:
    scene = _scene("dataset=beam_bend", "+effect@dataset.scene.effects.more=gravity", "dataset.scene.effects.more.acceleration=[0,0,-1]")
    assert scene.effects["more"] == Gravity(acceleration=(0.0, 0.0, -1.0))
    assert list(scene.effects) == ["wall", "weight", "more"]


def test_a_load_over_time_and_a_load_case_can_be_said_there_too() -> None:
    poke = "dataset.scene.load_cases.nose"
    scene = _scene(
        "+effect@dataset.scene.load_cases.nose=pressure_poke", f"{poke}.center=[0,0,1]", f"{poke}.history.times=[0,1]", f"{poke}.history.values=[0,2]"
    )
    assert scene.load_cases == {"nose": PressurePoke(center=(0.0, 0.0, 1.0), history=History((0.0, 1.0), (0.0, 2.0)))}


def test_the_effect_of_somebody_elses_package_acts_from_the_command_line(installed: Path, prepare: Command) -> None:
    said = prepare(*SMALL, "+effect@dataset.scene.effects.wind=side_wind", "dataset.scene.effects.wind.force=0.25")
    assert "wind: SideWind adds a constant load (strength_N 0.25)" in said


def test_an_unknown_effect_is_answered_with_the_known_ones(installed: Path, prepare: Command) -> None:
    said = prepare("+effect@dataset.scene.effects.weight=gravitation")
    assert "Could not find 'effect/gravitation'" in said
    for name in ("body_force", "gravity", "pinned", "pressure_poke", "side_wind", "traction"):
        assert f"\t{name}\n" in said


def test_a_wrong_field_is_answered_with_the_nearest(prepare: Command) -> None:
    said = prepare("+effect@dataset.scene.effects.weight=gravity", "dataset.scene.effects.weight.aceleration=[0,0,-1]")
    assert "Did you mean 'acceleration'? Known here: acceleration, history" in said


def test_a_field_that_must_be_given_is_asked_for(prepare: Command) -> None:
    said = prepare("+effect@dataset.scene.effects.more=pressure_poke")
    assert "these settings have no value yet: dataset.scene.effects.more.center: 3 numbers (m, on the surface); give each on the command line" in said
    assert "such as 'dataset.scene.effects.more.center=[0.0,0.0,0.0]'" in said


def test_an_effect_may_act_in_any_kind_of_region(plugin: Path) -> None:
    (plugin / "kite.py").write_text(SCENE + REGION)
    for choice, more, region in (
        ("pinned/ball", ["radius=0.5"], Ball(radius=0.5)),
        ("traction/box", ["lower=[0,0,0]"], BoxRegion(lower=(0.0, 0.0, 0.0))),
        ("initial_motion/half_space", ["normal=[1,0,0]"], HalfSpace(normal=(1.0, 0.0, 0.0))),
        ("inclusion/slab", ["height=2"], find_kinds(Region)["slab"](height=2.0)),
    ):
        place = "dataset.scene.effects.more"
        scene = _scene("dataset=beam_bend", f"+effect@{place}={choice}", *(f"{place}.region.{one}" for one in more))
        assert scene.effects["more"].region == region  # type: ignore[attr-defined]
        assert type(scene.effects["more"]) is find_effects()[choice.split("/")[0]]


def test_an_unknown_kind_of_region_is_answered_with_the_nearest(prepare: Command) -> None:
    said = prepare("+effect@dataset.scene.effects.more=pinned/bal")
    assert "Did you mean 'ball'?" in said


def test_the_readmes_pin_in_a_ball_is_planned(prepare: Command) -> None:
    (command,) = re.findall(r"```bash\npython prepare\.py (.*?pinned/ball.*?)```", README, flags=re.DOTALL)
    said = prepare(*(word for word in shlex.split(command) if word != "\n"), "dataset.scene.geometry.cells=[4,1,1]")
    assert "end: Pinned fixes 12 components of 4 nodes" in said


def test_a_dataset_that_no_command_line_can_hold_is_named(plugin: Path) -> None:
    (plugin / "kite.py").write_text(SCENE.replace('{"wind": SideWind()}', '{"wind": NodalForce(np.ones((27, 3)))}'))
    message = (
        r"dataset 'kite' must have fields of numbers, texts, tuples and dataclasses, found: .*; mend it: for arrays and functions derive a class of your own"
    )
    with pytest.raises(ConfigurationError, match=message):
        register_datasets(find_datasets([plugin]))


@pytest.mark.parametrize("value", ["3", "{pressure: 3}"])
def test_what_is_no_effect_is_refused_with_the_way_to_add_one(prepare: Command, value: str) -> None:
    said = prepare(f"+dataset.scene.effects.more={value}")
    assert "dataset.scene.effects.more must be an effect, found" in said
    assert "add one by its kind, such as +effect@dataset.scene.effects.more=gravity" in said


def test_the_effect_of_a_dataset_plugin_serves_other_datasets_and_is_the_same_class(plugin: Path) -> None:
    scene = _scene("dataset=beam_bend", "+effect@dataset.scene.effects.wind=side_wind")
    assert type(scene.effects["wind"]) is type(find_datasets()["kite"].scene.effects["wind"])
    assert find_effects()["side_wind"] is type(scene.effects["wind"])


def test_abstract_private_and_imported_classes_are_left_out(plugin: Path) -> None:
    assert set(find_effects([plugin])) == {*find_effects([]), "side_wind"}


def test_a_changed_plugin_file_is_loaded_again(plugin: Path) -> None:
    first = find_effects([plugin])["side_wind"]
    (plugin / "kite.py").write_text(SCENE.replace("1e-4", "2e-4"))
    assert first().force == 1e-4  # type: ignore[attr-defined]
    assert find_effects([plugin])["side_wind"]().force == 2e-4  # type: ignore[attr-defined]


def test_names_are_the_words_of_the_class(plugin: Path) -> None:
    (plugin / "more.py").write_text(EFFECT.replace("SideWind", "MRICoil2Tesla"))
    assert "mri_coil2_tesla" in find_effects([plugin])


def test_one_name_twice_is_an_error_with_both_files(plugin: Path) -> None:
    (plugin / "again.py").write_text(EFFECT)
    with pytest.raises(ConfigurationError, match=r"two plugins define the Effect 'side_wind': '.*/again\.py' and '.*/kite\.py'; rename one"):
        find_effects([plugin])
    (plugin / "again.py").write_text(EFFECT.replace("SideWind", "Traction"))
    with pytest.raises(ConfigurationError, match=r"the Effect 'traction': '.*/effects/traction\.py' and '.*/again\.py'; rename one"):
        find_effects([plugin])


def test_a_region_of_ones_own_takes_no_name_of_sdfnets(plugin: Path) -> None:
    (plugin / "kite.py").write_text(EFFECT + REGION.replace("Slab", "Ball"))
    with pytest.raises(ConfigurationError, match=r"two plugins define the Region 'ball': '.*/physics/regions\.py' and '.*/kite\.py'; rename one"):
        register("prepare")


def test_an_installation_from_before_the_entry_points_is_named_with_the_cure(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = [point for point in importlib.metadata.entry_points(group="sdfnet.effects") if point.value == "windy_effects"]
    assert len(others) == 1
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: others if group == "sdfnet.effects" else [])
    message = (
        "sdfnet's own effects must be among the entry points of the group sdfnet.effects, found none: .*install it again, in a checkout with pip install --ed"
    )
    with pytest.raises(ConfigurationError, match=message):
        find_effects([])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("import nowhere_at_all", "effect plugin 'windy_effects' failed to load: ModuleNotFoundError.*; mend or uninstall it"),
        ("wind = 3", r"effect plugin 'windy_effects' must define an effect, found none in '.*windy_effects\.py'; mend or uninstall it"),
    ],
)
def test_a_broken_package_is_named(installed: Path, content: str, message: str) -> None:
    (installed / "windy_effects.py").write_text(content)
    with pytest.raises(ConfigurationError, match=message):
        find_effects([])


def test_an_effect_that_no_command_line_can_hold_is_named(plugin: Path) -> None:
    (plugin / "kite.py").write_text(EFFECT.replace("force: float = 1e-4", "force: np.ndarray = None"))
    message = (
        r"effect 'side_wind' in '.*kite\.py' must have fields of numbers, texts, tuples and dataclasses, found: .*ndarray.*; mend it, or begin its name with _"
    )
    with pytest.raises(ConfigurationError, match=message):
        register_effects(find_effects([plugin]))


def test_both_groups_may_name_one_module(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = list(importlib.metadata.entry_points(group="sdfnet.effects"))
    again = SimpleNamespace(module="windy_effects", value="windy_effects")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: own if group == "sdfnet.effects" else [again])
    assert "side_wind" in find_effects([])
