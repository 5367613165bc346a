"""Finds dataset plugins and puts them into Hydra's config store; turns a composed configuration back into its frozen objects.

A plugin is a Python file in a folder named `datasets` (the project's own, or one in the working folder) or a module named by
an entry point of the group `sdfnet.datasets`. It defines functions decorated with `dataset`, each returning a `Dataset`.
"""

import hashlib
import importlib.metadata
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterable
from dataclasses import is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, ListConfig, OmegaConf

from sdfnet.errors import ConfigurationError
from sdfnet.scene import Dataset

DatasetFunction = Callable[[], Dataset]

ENTRY_POINT_GROUP = "sdfnet.datasets"
MARK = "__sdfnet_dataset__"
# Plugin files are loaded under this package, so that a folder named datasets never shadows another package of that name.
PLUGIN_PACKAGE = "sdfnet_dataset_plugins"


def dataset(function: DatasetFunction) -> DatasetFunction:
    """Mark a function without arguments as a dataset; its name is the dataset's name on the command line."""
    if inspect.signature(function).parameters:
        raise ConfigurationError(f"a dataset function takes no arguments, found {function.__name__}{inspect.signature(function)}")
    setattr(function, MARK, True)
    return function


def shipped(folder: str) -> Path:
    """The `conf` or `datasets` folder that comes with sdfnet: inside the installed package, or in the source checkout."""
    installed = Path(__file__).parent / "shipped" / folder
    return installed if installed.is_dir() else Path(__file__).parents[2] / folder


def find_datasets(folders: Iterable[Path] | None = None) -> dict[str, Dataset]:
    """Every dataset by name: of the folders (default: the shipped one and ./datasets), then of the entry points.

    Raises ConfigurationError when a plugin does not load, when one of its functions makes no dataset, or when two
    files define one name.
    """
    searched = [shipped("datasets"), Path("datasets")] if folders is None else list(folders)
    # By name and content: an installed sdfnet that runs inside a checkout sees the same files twice, and means them once.
    files = {(path.name, path.read_bytes()): path.resolve() for folder in searched if folder.is_dir() for path in sorted(folder.glob("*.py"))}
    found: dict[str, Dataset] = {}
    origins: dict[str, Path] = {}
    for module in [*(_loaded_file(path) for path in sorted(files.values())), *_entry_point_modules()]:
        origin = Path(str(module.__file__)).resolve()
        for name, function in vars(module).items():
            if getattr(function, MARK, False) and f"{function.__module__}.".startswith(f"{module.__name__}."):
                if origins.setdefault(name, origin) != origin:
                    raise ConfigurationError(f"two plugins define a dataset named '{name}': '{origins[name]}' and '{origin}'; rename one")
                found[name] = _made_by(function, origin)
    return found


def register_datasets(datasets: dict[str, Dataset]) -> None:
    """Put datasets into Hydra's config group `dataset`, where every field can be overridden and is type-checked."""
    for name, made in datasets.items():
        ConfigStore.instance().store(group="dataset", name=name, node=writable(made), provider="sdfnet")


def writable(settings: Any) -> DictConfig:
    """A frozen dataclass, or its class, as a type-checked node that the command line can override."""
    node = OmegaConf.structured(settings)
    _make_writable(node)
    return node


def frozen(config: DictConfig) -> Any:
    """The dataclass objects that a structured configuration stands for, its lists turned back into tuples.

    Raises ConfigurationError when a value that must be given is missing.
    """
    missing = OmegaConf.missing_keys(config)
    if missing:
        raise ConfigurationError(f"these settings have no value yet: {', '.join(sorted(missing))}; give each on the command line")
    return _object(config)


def _loaded_file(path: Path) -> ModuleType:
    name = f"{PLUGIN_PACKAGE}.{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"  # two folders may hold files of one name
    specification = importlib.util.spec_from_file_location(name, path)
    if specification is None or specification.loader is None:
        raise ConfigurationError(f"dataset plugin '{path}' cannot be loaded as Python")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    try:
        specification.loader.exec_module(module)
    except Exception as error:
        raise ConfigurationError(f"dataset plugin '{path}' failed to load: {type(error).__name__}: {error}; mend it or move it out of the folder") from error
    return module


def _entry_point_modules() -> list[ModuleType]:
    modules = []
    for entry_point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
        try:
            modules.append(importlib.import_module(entry_point.module))
        except Exception as error:
            raise ConfigurationError(f"dataset plugin '{entry_point.value}' failed to load: {type(error).__name__}: {error}; mend or uninstall it") from error
    return modules


def _made_by(function: DatasetFunction, origin: Path) -> Dataset:
    made = function()
    if not isinstance(made, Dataset):
        raise ConfigurationError(f"dataset '{function.__name__}' in '{origin}' must return a Dataset, found {type(made).__name__}")
    return made


def _make_writable(node: DictConfig | ListConfig) -> None:
    """Frozen dataclasses become read-only nodes; undo that all the way down."""
    OmegaConf.set_readonly(node, None)
    if node._is_missing() or node._is_none():
        return
    keys: list[Any] = list(node.keys()) if isinstance(node, DictConfig) else list(range(len(node)))
    for key in keys:
        child = node._get_node(key)
        if isinstance(child, DictConfig | ListConfig):
            _make_writable(child)


def _object(node: Any) -> Any:
    """The dataclass that a node stands for, made once and with tuples; OmegaConf.to_object would make it with lists."""
    if isinstance(node, DictConfig):
        values = {str(key): _object(node[key]) for key in node}
        kind = OmegaConf.get_type(node)
        return kind(**values) if kind is not None and is_dataclass(kind) else values
    if isinstance(node, ListConfig):
        return tuple(_object(item) for item in node)
    return node
