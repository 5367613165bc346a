"""A dataset is one file; what it returns is its configuration."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfnet.cli.entry import register
from sdfnet.errors import ConfigurationError
from sdfnet.geometry.solids import Sphere
from sdfnet.physics.simulate import simulate
from sdfnet.plugins import dataset, find_datasets, frozen, register_datasets, shipped, writable
from sdfnet.scene import Dataset

OWN = '''
from dataclasses import dataclass

import numpy as np

from sdfnet.geometry.solids import Sphere
from sdfnet.physics.effects.roles import AddsLoad, Load
from sdfnet.plugins import dataset
from sdfnet.scene import Dataset, Recording, Sampling, Scene


@dataclass(frozen=True)
class Wind(AddsLoad):
    """Blows on every node."""

    force: tuple[float, float, float] = (1e-4, 0.0, 0.0)  # N in all

    def load(self, model):
        return Load(np.tile(np.asarray(self.force) / len(model.mesh.nodes), (len(model.mesh.nodes), 1)))


@dataset
def kite() -> Dataset:
    """A ball in the wind."""
    scene = Scene(Sphere(radius=0.05, cells=3), {"wind": Wind(), "gust": Wind(force=(0.0, 1e-4, 0.0))}, recording=Recording(duration=1e-4, frames=2))
    return Dataset(scene, Sampling(count=100, near_surface_count=0))
'''


@pytest.fixture(autouse=True)
def _clean_store(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Datasets that a test registers are gone after it."""
    monkeypatch.setattr(ConfigStore.instance(), "repo", {key: value for key, value in ConfigStore.instance().repo.items() if key != "dataset"})
    loaded = set(sys.modules)
    yield
    for name in set(sys.modules) - loaded:
        if name.startswith("sdfnet_dataset_plugins"):
            del sys.modules[name]


@pytest.fixture
def kite() -> Path:
    Path("datasets").mkdir()
    Path("datasets/kite.py").write_text(OWN)
    return Path("datasets")


def _composed(name: str, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(shipped("conf").resolve()), version_base="1.3"):
        return compose(name, list(overrides))


def _dataset(*overrides: str) -> Dataset:
    register()
    found = frozen(_composed("prepare", *overrides)).dataset
    assert isinstance(found, Dataset)
    return found


def test_one_file_with_an_effect_of_its_own_is_a_dataset_that_simulates(kite: Path) -> None:
    found = find_datasets([kite])
    assert list(found) == ["kite"]
    register_datasets(found)
    scene = _dataset("dataset=kite", "dataset.scene.effects.wind.force=[0,0,2e-4]").scene
    assert type(scene.effects["wind"]).__name__ == "Wind"
    trajectory = simulate(scene, mesh := Sphere(radius=0.05, cells=3).tet_mesh())
    mass = np.bincount(mesh.tets.ravel(), np.repeat(mesh.volumes / 4, 4))  # density 1
    drift = mass @ trajectory.displacements[1] / mass.sum()
    np.testing.assert_allclose(drift, 0.5 * np.array([0.0, 1e-4, 2e-4]) / mass.sum() * 1e-4**2, rtol=1e-9, atol=1e-15)  # F t^2 / 2 m


def test_the_working_folders_datasets_join_the_shipped_ones(kite: Path) -> None:
    assert set(find_datasets()) == {"kite", "beam_bend", "bunny_poke", "sphere_squeeze"}


def test_no_plugin_shadows_a_package_named_datasets(kite: Path) -> None:
    find_datasets([kite])
    assert "datasets" not in sys.modules
    assert "kite" not in sys.modules


def test_two_files_of_one_name_in_two_folders_are_two_plugins(kite: Path) -> None:
    Path("more").mkdir()
    Path("more/kite.py").write_text(OWN.replace("def kite", "def glider"))
    found = find_datasets([kite, Path("more")])
    assert set(found) == {"kite", "glider"}
    modules = {type(made.scene.effects["wind"]).__module__ for made in found.values()}
    assert len(modules) == 2
    assert all(module in sys.modules for module in modules)


def test_one_name_in_two_files_is_an_error_with_both_paths(kite: Path) -> None:
    (kite / "again.py").write_text(OWN)
    with pytest.raises(ConfigurationError, match=r"two plugins define a dataset named 'kite': '.*/datasets/again\.py' and '.*/datasets/kite\.py'; rename one"):
        find_datasets([kite])


def test_a_dataset_that_a_file_imports_from_another_is_not_its_own(kite: Path) -> None:
    (kite / "other.py").write_text("import sdfnet.plugins\nfrom sdfnet.scene import Dataset\n\n\ndef helper() -> Dataset: ...\n")
    assert list(find_datasets([kite])) == ["kite"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("import nowhere_at_all", "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("def broken(:", "SyntaxError"),
        ("from sdfnet.plugins import dataset\n\n@dataset\ndef one(size):\n    return size\n", r"takes no arguments, found one\(size\)"),
    ],
    ids=["import", "syntax", "arguments"],
)
def test_a_broken_plugin_is_an_error_with_its_path_and_reason(kite: Path, content: str, reason: str) -> None:
    (kite / "broken.py").write_text(content)
    with pytest.raises(ConfigurationError, match=rf"dataset plugin '.*/datasets/broken\.py' failed to load: .*{reason}.*; mend it or move it out"):
        find_datasets([kite])


def test_a_dataset_that_returns_something_else_is_named(kite: Path) -> None:
    (kite / "seven.py").write_text("from sdfnet.plugins import dataset\n\n@dataset\ndef seven():\n    return 7\n")
    with pytest.raises(ConfigurationError, match=r"dataset 'seven' in '.*seven\.py' must return a Dataset, found int"):
        find_datasets([kite])


def test_entry_points_are_found_and_a_broken_one_is_named(kite: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("installed_kites.py").write_text(OWN.replace("def kite", "def installed_kite"))
    monkeypatch.syspath_prepend(str(Path.cwd()))
    points = [SimpleNamespace(module="installed_kites", value="installed_kites")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: points if group == "sdfnet.datasets" else [])
    assert set(find_datasets([kite])) == {"kite", "installed_kite"}
    points.append(SimpleNamespace(module="not_installed", value="not_installed"))
    with pytest.raises(ConfigurationError, match="dataset plugin 'not_installed' failed to load: ModuleNotFoundError.*; mend or uninstall it"):
        find_datasets([kite])
    sys.modules.pop("installed_kites")


def test_a_folder_that_is_not_there_holds_no_datasets() -> None:
    assert find_datasets([Path("nowhere")]) == {}


def test_a_dataset_survives_the_way_through_hydra_unchanged() -> None:
    for name, made in find_datasets([shipped("datasets")]).items():
        assert _dataset(f"dataset={name}") == made


def test_tuples_come_back_as_tuples_with_overrides_in_them() -> None:
    made = _dataset("dataset=beam_bend", "dataset.scene.geometry.cells=[4,2,2]", "dataset.scene.effects.weight.density=[0,1,2.5]")
    assert made.scene.geometry.cells == (4, 2, 2)  # type: ignore[attr-defined]
    assert made.scene.effects["weight"].density == (0.0, 1.0, 2.5)  # type: ignore[attr-defined]
    assert made.scene.effects["wall"].components == (True, True, True)  # type: ignore[attr-defined]


def test_every_level_can_be_overridden_and_the_rest_stays() -> None:
    made = _dataset("dataset=sphere_squeeze", "dataset.scene.effects.left.pressure=7", "dataset.scene.solver.time_step=1e-6", "dataset.sampling.count=11")
    assert made.scene.effects["left"].pressure == 7.0  # type: ignore[attr-defined]
    assert made.scene.effects["right"].pressure == 1000.0  # type: ignore[attr-defined]
    assert made.scene.solver.time_step == 1e-6
    assert (made.sampling.count, made.sampling.near_surface_count) == (11, 10_000)


def test_an_effect_is_removed_with_a_tilde() -> None:
    assert set(_dataset("dataset=sphere_squeeze", "~dataset.scene.effects.right").scene.effects) == {"left"}


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("dataset.scene.effects.left.pressure=hard", "'hard' of type 'str' could not be converted to Float"),
        ("dataset.scene.geometry.cells=2.5", "'2.5' of type 'float' could not be converted to Integer"),
        ("dataset.scene.recording.frames=null", "field 'dataset.scene.recording.frames' is not Optional"),
        ("dataset.scene.geometry.radios=1", "radios"),
    ],
)
def test_a_wrong_type_or_key_is_refused_at_composition(override: str, reason: str) -> None:
    register()
    with pytest.raises((ConfigCompositionException, OmegaConfBaseException)) as caught:
        _composed("prepare", "dataset=sphere_squeeze", override)
    assert reason in f"{caught.value} {caught.value.__cause__}"


def test_what_the_object_itself_refuses_keeps_its_own_words() -> None:
    register()
    with pytest.raises(ConfigurationError, match=r"material\.poisson_ratio must lie in \(-1, 0\.5\), found 0\.5"):
        frozen(_composed("prepare", "dataset=sphere_squeeze", "dataset.scene.material.poisson_ratio=0.5"))


@dataclass(frozen=True)
class Inner:
    """Settings inside settings."""

    pair: tuple[int, int] = (1, 2)


@dataclass(frozen=True)
class Outer:
    """Settings with all that a plugin may hold."""

    needed: int
    inner: Inner = field(default_factory=Inner)
    named: dict[str, Inner] = field(default_factory=lambda: {"a": Inner()})
    nothing: float | None = None


def test_nested_settings_are_writable_and_come_back_frozen_and_equal() -> None:
    settings = Outer(needed=1)
    node: Any = writable(settings)
    node.named.a.pair[1] = 9
    node.nothing = 0.5
    assert frozen(node) == Outer(1, named={"a": Inner((1, 9))}, nothing=0.5)
    assert settings == Outer(needed=1)


def test_a_setting_without_a_value_is_named() -> None:
    with pytest.raises(ConfigurationError, match="these settings have no value yet: needed; give each on the command line"):
        frozen(writable(Outer))


def _choices(group: str) -> list[str]:
    return [f"{group}={path.stem}" for path in sorted((shipped("conf") / group).glob("*.yaml"))]


COMMANDS = [
    ("train", []),
    *[("train", [choice]) for group in ("model", "batch", "optimizer", "training", "experiment") for choice in _choices(group)],
    *[("train", [f"dataset={path.stem}"]) for path in sorted(shipped("datasets").glob("*.py"))],
    ("prepare", []),
    ("evaluate", ["checkpoint=some.ckpt"]),
    ("cost", []),
]


@pytest.mark.parametrize(("command", "overrides"), COMMANDS, ids=[" ".join([command, *overrides]) for command, overrides in COMMANDS])
def test_every_shipped_page_composes_and_becomes_its_objects(command: str, overrides: list[str]) -> None:
    register()
    config = _composed(command, *overrides)
    settings = frozen(config)
    assert type(settings).__name__ == f"{command.title()}Settings"
    assert not OmegaConf.missing_keys(config)
    for key in config:
        assert hasattr(settings, str(key))


def test_every_yaml_is_covered_by_the_commands() -> None:
    pages = {path.relative_to(shipped("conf")).with_suffix("").as_posix() for path in shipped("conf").rglob("*.yaml")}
    covered = {command for command, _ in COMMANDS} | {override.replace("=", "/") for _, overrides in COMMANDS for override in overrides}
    assert pages <= covered


def test_the_papers_experiment_has_the_papers_numbers() -> None:
    register()
    settings = frozen(_composed("train", "experiment=paper"))
    scene, sampling = settings.dataset.scene, settings.dataset.sampling
    assert (scene.solver.mass, scene.solver.start, scene.solver.time_step) == ("consistent", "rest", 1e-6)
    assert (scene.recording.duration, scene.recording.frames) == (0.01, 101)
    assert (scene.material.youngs_modulus, scene.material.poisson_ratio, scene.material.density) == (5e3, 0.4, 1.0)
    assert (scene.effects["poke"].radius, scene.effects["poke"].pressure) == (0.003, 4000.0)
    assert (sampling.count, sampling.near_surface_count, sampling.box_scale, sampling.z_exponent, sampling.z_floor) == (1_000_000, 0, 1.5, 0.5, 0.001)
    assert (sampling.weight_outside, sampling.weight_inside, abs(sampling.decay)) == (0.8, 3.0, 10.0)
    assert (settings.model.width, settings.model.depth, settings.model.latent, settings.model.encoding) == (256, 3, 128, "none")
    assert (settings.optimizer.encoder_rate, settings.optimizer.decoder_rate) == (0.0075, 0.005)
    assert (settings.training.epochs, settings.batch.ordered_epochs, settings.batch.frames_per_step) == (592, 6, 2)
    assert [(phase.trains, phase.epochs) for phase in settings.training.cycle] == [("both", 7), ("encoder", 5), ("decoder", 12)]
    plateaus = [(one.first_epoch, one.last_epoch, one.patience, one.factor) for one in settings.optimizer.plateaus]
    assert plateaus == [(3, 19, 30, 0.92), (20, None, 2, 0.75)]


def test_a_dataset_function_with_arguments_is_refused_where_it_is_marked() -> None:
    def sized(size: int) -> Dataset:
        raise AssertionError(size)

    with pytest.raises(ConfigurationError, match=r"a dataset function takes no arguments, found sized\(size: int\)"):
        dataset(sized)  # type: ignore[arg-type]


def test_a_copy_of_a_plugin_is_the_same_plugin(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "sphere_squeeze.py").write_text((shipped("datasets") / "sphere_squeeze.py").read_text())
    assert set(find_datasets([tmp_path / "one", tmp_path / "two"])) == {"sphere_squeeze"}
