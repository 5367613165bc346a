"""A dataset is one file: where it is looked for, and what is said when it is broken."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.solids import Sphere
from sdfnet.physics.simulate import simulate
from sdfnet.plugins import dataset, find_datasets, register_datasets, shipped
from sdfnet.scene import Dataset
from tests.composition import composed_dataset

pytestmark = pytest.mark.usefixtures("clean_store")

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


@pytest.fixture
def kite() -> Path:
    Path("datasets").mkdir()
    Path("datasets/kite.py").write_text(OWN)
    return Path("datasets")


def test_one_file_with_an_effect_of_its_own_is_a_dataset_that_simulates(kite: Path) -> None:
    found = find_datasets([kite])
    assert list(found) == ["kite"]
    register_datasets(found)
    scene = composed_dataset("dataset=kite", "dataset.scene.effects.wind.force=[0,0,2e-4]").scene
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


def test_a_copy_of_a_plugin_is_the_same_plugin(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "sphere_squeeze.py").write_text((shipped("datasets") / "sphere_squeeze.py").read_text())
    assert set(find_datasets([tmp_path / "one", tmp_path / "two"])) == {"sphere_squeeze"}


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


def test_a_dataset_function_with_arguments_is_refused_where_it_is_marked() -> None:
    def sized(size: int) -> Dataset:
        raise AssertionError(size)

    with pytest.raises(ConfigurationError, match=r"a dataset function takes no arguments, found sized\(size: int\)"):
        dataset(sized)  # type: ignore[arg-type]


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
