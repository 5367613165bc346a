"""Finds datasets and effects and puts them into Hydra's config store; turns a composed configuration back into its frozen objects.

A dataset plugin is a Python file in a folder named `datasets` (the project's own, or one in the working folder) or a module
named by an entry point of the group `sdfnet.datasets`. It defines functions decorated with `dataset`, each returning a
`Dataset`, and may define effects. A module named by an entry point of the group `sdfnet.effects` defines effects; sdfnet's
own are found by this group too.
"""

import hashlib
import importlib.metadata
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfnet.errors import ConfigurationError
from sdfnet.scene import Dataset, Effect, Scene

DatasetFunction = Callable[[], Dataset]

DATASETS_GROUP, EFFECTS_GROUP = "sdfnet.datasets", "sdfnet.effects"  # of entry points
OWN_EFFECTS = "sdfnet.physics.effects."
WORD_START = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
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
    found: dict[str, Dataset] = {}
    origins: dict[str, Path] = {}
    for module in _dataset_modules(folders):
        origin = _origin(module)
        for name, function in vars(module).items():
            if getattr(function, MARK, False) and _belongs_to(function, module):
                if origins.setdefault(name, origin) != origin:
                    raise ConfigurationError(f"two plugins define a dataset named '{name}': '{origins[name]}' and '{origin}'; rename one")
                found[name] = _made_by(function, origin)
    return found


def find_effects(folders: Iterable[Path] | None = None) -> dict[str, type[Effect]]:
    """Every kind of effect by its name, `PressurePoke` as `pressure_poke`: of the entry points, then of the dataset plugins.

    Abstract classes and those whose name begins with an underscore are left out. Raises ConfigurationError when a plugin
    does not load or brings no effect, when two define one name, and when sdfnet was installed before it had entry points.
    """
    found: dict[str, type[Effect]] = {}
    for module in [*_effect_modules(), *_dataset_modules(folders)]:
        for kind in _effects_of(module):
            name = WORD_START.sub("_", kind.__name__).lower()
            if found.setdefault(name, kind) is not kind:
                first, second = (_origin(sys.modules[one.__module__]) for one in (found[name], kind))
                raise ConfigurationError(f"two plugins define an effect named '{name}': '{first}' and '{second}'; rename one")
    return found


def register_datasets(datasets: dict[str, Dataset]) -> None:
    """Put datasets into Hydra's config group `dataset`, where every field can be overridden and is type-checked."""
    for name, made in datasets.items():
        ConfigStore.instance().store(group="dataset", name=name, node=writable(made), provider="sdfnet")


def register_effects(effects: dict[str, type[Effect]]) -> None:
    """Put effects into Hydra's config group `effect`: `+effect@dataset.scene.effects.weight=gravity` adds one to a scene.

    Raises ConfigurationError for an effect with a field that no command line can hold.
    """
    for name, kind in effects.items():
        try:
            ConfigStore.instance().store(group="effect", name=name, node=writable(kind), provider="sdfnet")
        except OmegaConfBaseException as error:
            origin, reason = _origin(sys.modules[kind.__module__]), str(error).splitlines()[0]
            raise ConfigurationError(
                f"effect '{name}' in '{origin}' must have fields of numbers, texts, tuples and dataclasses, found: {reason}; mend it, or begin its name with _"
            ) from error


def writable(settings: Any) -> DictConfig:
    """A frozen dataclass, or its class, as a type-checked node that the command line can override."""
    node = OmegaConf.structured(settings)
    _make_writable(node)
    return node


def frozen(config: DictConfig) -> Any:
    """The dataclass objects that a structured configuration stands for, its lists turned back into tuples.

    Raises ConfigurationError when a value that must be given is missing.
    """
    if missing := OmegaConf.missing_keys(config):
        raise ConfigurationError(f"these settings have no value yet: {', '.join(sorted(missing))}; give each on the command line")
    return _object(config)


def _dataset_modules(folders: Iterable[Path] | None) -> list[ModuleType]:
    searched = [shipped("datasets"), Path("datasets")] if folders is None else list(folders)
    # By name and content: an installed sdfnet that runs inside a checkout sees the same files twice, and means them once.
    files = {(path.name, path.read_bytes()): path.resolve() for folder in searched if folder.is_dir() for path in sorted(folder.glob("*.py"))}
    return [*(_loaded_file(path) for path in sorted(files.values())), *_entry_point_modules(DATASETS_GROUP, "dataset")]


def _effect_modules() -> list[ModuleType]:
    modules = _entry_point_modules(EFFECTS_GROUP, "effect")
    if not any(module.__name__.startswith(OWN_EFFECTS) for module in modules):
        raise ConfigurationError(
            f"sdfnet's own effects must be among the entry points of the group {EFFECTS_GROUP}, found none: "
            "it was installed before it had them; install it again, in a checkout with pip install --editable ."
        )
    for module in modules:
        if not _effects_of(module):
            raise ConfigurationError(f"effect plugin '{module.__name__}' must define an effect, found none in '{_origin(module)}'; mend or uninstall it")
    return modules


def _effects_of(module: ModuleType) -> list[type[Effect]]:
    kinds = [kind for kind in vars(module).values() if inspect.isclass(kind) and issubclass(kind, Effect) and _belongs_to(kind, module)]
    return [kind for kind in kinds if not inspect.isabstract(kind) and not kind.__name__.startswith("_")]


def _belongs_to(thing: Any, module: ModuleType) -> bool:
    """Whether it was defined in the module or in a part of it, and not only imported there."""
    return f"{thing.__module__}.".startswith(f"{module.__name__}.")


def _origin(module: ModuleType) -> Path:
    return Path(str(module.__file__)).resolve()


def _loaded_file(path: Path) -> ModuleType:
    """The module of a file; asked again it is the same one, so that a class of it stays one class."""
    # Two folders may hold files of one name, and a file may change while a notebook runs.
    name = f"{PLUGIN_PACKAGE}.{path.stem}_{hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    specification = importlib.util.spec_from_file_location(name, path)
    if specification is None or specification.loader is None:
        raise ConfigurationError(f"dataset plugin '{path}' cannot be loaded as Python")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    try:
        specification.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise ConfigurationError(f"dataset plugin '{path}' failed to load: {type(error).__name__}: {error}; mend it or move it out of the folder") from error
    return module


def _entry_point_modules(group: str, what: str) -> list[ModuleType]:
    modules = []
    for entry_point in importlib.metadata.entry_points(group=group):
        try:
            modules.append(importlib.import_module(entry_point.module))
        except Exception as error:
            raise ConfigurationError(f"{what} plugin '{entry_point.value}' failed to load: {type(error).__name__}: {error}; mend or uninstall it") from error
    return modules


def _made_by(function: DatasetFunction, origin: Path) -> Dataset:
    try:
        made = function()
    except Exception as error:
        raise ConfigurationError(f"dataset '{function.__name__}' in '{origin}' failed: {type(error).__name__}: {error}; mend it or move it out") from error
    if not isinstance(made, Dataset):
        raise ConfigurationError(f"dataset '{function.__name__}' in '{origin}' must return a Dataset, found {type(made).__name__}")
    return made


def _make_writable(node: DictConfig | ListConfig) -> None:
    """Frozen dataclasses become read-only nodes; undo that all the way down."""
    OmegaConf.set_readonly(node, None)
    if node._is_missing() or node._is_none():
        return
    if node._metadata.element_type is Effect:
        # OmegaConf would start a new effect from an empty and read-only Effect; `_object` checks instead what it becomes.
        node._metadata.element_type = Any
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
        if kind is Scene:
            _require_effects(node, values)
        if kind is None or not is_dataclass(kind):
            return values
        _require_fields(node, kind, values)
        return kind(**values)
    if isinstance(node, ListConfig):
        return tuple(_object(item) for item in node)
    return node


def _require_effects(scene: DictConfig, values: dict[str, Any]) -> None:
    for group in ("effects", "load_cases"):
        for name in (name for name, value in values[group].items() if not isinstance(value, Effect)):
            place, found = scene[group]._get_full_key(name), values[group][name]
            raise ConfigurationError(f"{place} must be an effect, found {found!r}; add one by its kind, such as +effect@{place}=gravity")


def _require_fields(node: DictConfig, kind: type, values: dict[str, Any]) -> None:
    """What OmegaConf lets pass: a name added with + that is no field, and a tuple of the wrong length."""
    known, hints = [entry.name for entry in fields(kind)], get_type_hints(kind)
    for name, value in values.items():
        place, length = node._get_full_key(name), _tuple_length(hints.get(name))
        if name not in known:
            raise ConfigurationError(f"{place} must be a setting, found none of that name; known here: {', '.join(known)}")
        if isinstance(value, tuple) and length not in (None, len(value)):
            raise ConfigurationError(f"{place} must have {length} values, found {len(value)}: {list(value)}")


def _tuple_length(hint: Any) -> int | None:
    """How many values a field holds that is a tuple of fixed length, or none; None where any number may stand."""
    kinds = next((get_args(choice) for choice in (hint, *get_args(hint)) if get_origin(choice) is tuple), (Ellipsis,))
    return None if Ellipsis in kinds else len(kinds)
