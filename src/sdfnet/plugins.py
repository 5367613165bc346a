"""Finds datasets and effects and puts them into Hydra's config store; turns a composed configuration back into its frozen objects.

A dataset plugin is a Python file in a folder named `datasets` (the project's own, or one in the working folder) or a module
named by an entry point of the group `sdfnet.datasets`. It defines functions decorated with `dataset`, each returning a
`Dataset`, and may define effects. A module named by an entry point of the group `sdfnet.effects` defines effects; sdfnet's
own are found by this group too.
"""

import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfnet.declared import expected, placeholder, words_of
from sdfnet.errors import ConfigurationError
from sdfnet.plugin_modules import belongs_to, classes_by_name, dataset_modules, effect_modules, origin_of
from sdfnet.scene import Dataset, Effect, Scene

DatasetFunction = Callable[[], Dataset]

MARK = "__sdfnet_dataset__"


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
    for module in dataset_modules(_searched(folders)):
        origin = origin_of(module)
        for name, function in vars(module).items():
            if getattr(function, MARK, False) and belongs_to(function, module):
                if origins.setdefault(name, origin) != origin:
                    raise ConfigurationError(f"two plugins define a dataset named '{name}': '{origins[name]}' and '{origin}'; rename one")
                found[name] = _made_by(function, origin)
    return found


def find_effects(folders: Iterable[Path] | None = None) -> dict[str, type[Effect]]:
    """Every kind of effect by its name, `PressurePoke` as `pressure_poke`: of the entry points, then of the dataset plugins.

    Abstract classes and those whose name begins with an underscore are left out. Raises ConfigurationError when a plugin
    does not load or brings no effect, when two define one name, and when sdfnet was installed before it had entry points.
    """
    return find_kinds(Effect, folders)


def find_kinds(base: Any, folders: Iterable[Path] | None = None, known: Mapping[str, type[Any]] | None = None) -> dict[str, type[Any]]:
    """The `known` classes, and every class that plugins derive from `base`, by its name as `find_effects` has it.

    Raises ConfigurationError when two have one name.
    """
    return classes_by_name(base, [*effect_modules(), *dataset_modules(_searched(folders))], known or {})


def register_datasets(datasets: dict[str, Dataset]) -> None:
    """Put datasets into Hydra's config group `dataset`, where every field can be overridden and is type-checked.

    Raises ConfigurationError for a dataset with a field that no command line can hold.
    """
    for name, made in datasets.items():
        with _told(f"dataset '{name}'", "mend it: for arrays and functions derive a class of your own from Effect or Region"):
            ConfigStore.instance().store(group="dataset", name=name, node=writable(made), provider="sdfnet")


def register_effects(effects: dict[str, type[Effect]], choices: Mapping[type, Mapping[str, type]] | None = None) -> None:
    """Put effects into Hydra's config group `effect`: `+effect@dataset.scene.effects.weight=gravity` adds one to a scene.

    `choices` are the kinds of a type of field, by name: with {Region: {"ball": Ball}} there is `pinned/ball` beside `pinned`,
    its region a ball. Raises ConfigurationError for an effect or a kind with a field that no command line can hold.
    """
    for name, kind in effects.items():
        with _told(f"effect '{name}' in '{origin_of(sys.modules[kind.__module__])}'", "mend it, or begin its name with _"):
            ConfigStore.instance().store(group="effect", name=name, node=writable(kind), provider="sdfnet")
        hints = get_type_hints(kind)
        chosen = [(entry.name, *choice) for entry in fields(kind) for choice in (choices or {}).get(hints[entry.name], {}).items()]
        for field_name, choice, part in chosen:
            with _told(f"'{choice}' in '{origin_of(sys.modules[part.__module__])}'", "mend it, or begin its name with _"):
                node = writable(kind)
                node[field_name] = writable(part)
                ConfigStore.instance().store(group=f"effect/{name}", name=choice, node=node, provider="sdfnet")


def writable(settings: Any) -> DictConfig:
    """A frozen dataclass, or its class, as a type-checked node that the command line can override."""
    node = OmegaConf.structured(settings)
    _make_writable(node)
    return node


def frozen(config: DictConfig) -> Any:
    """The dataclass objects that a structured configuration stands for, its lists turned back into tuples.

    Raises ConfigurationError when a value that must be given is missing.
    """
    if missing := sorted(OmegaConf.missing_keys(config)):
        wanted = [_wanted(config, key) for key in missing]
        written = " ".join(f"'{key}={right}'" for key, (_, right) in zip(missing, wanted, strict=True) if right)
        raise ConfigurationError(
            f"these settings have no value yet: {', '.join(f'{key}{what}' for key, (what, _) in zip(missing, wanted, strict=True))}; "
            f"give each on the command line{f', such as {written}' if written else ''}"
        )
    return _object(config)


def _searched(folders: Iterable[Path] | None) -> Iterable[Path]:
    """The folders for datasets: those that are told, else the shipped one and ./datasets."""
    return [shipped("datasets"), Path("datasets")] if folders is None else folders


def _wanted(config: DictConfig, key: str) -> tuple[str, str]:
    """What a setting without a value must be, in words, and numbers that could stand there; both empty where nothing is declared."""
    parent, _, name = key.rpartition(".")
    kind = OmegaConf.get_type(OmegaConf.select(config, parent) if parent else config)
    if kind is None or not is_dataclass(kind):
        return "", ""
    hint, about = get_type_hints(kind)[name], words_of(kind, name)
    return f": {expected(hint)}{f' ({about})' if about else ''}", placeholder(hint).translate(str.maketrans("()", "[]", " "))


@contextmanager
def _told(what: str, cure: str) -> Iterator[None]:
    """Say it in our words where OmegaConf cannot hold something."""
    try:
        yield
    except OmegaConfBaseException as error:
        reason = str(error).splitlines()[0]
        raise ConfigurationError(f"{what} must have fields of numbers, texts, tuples and dataclasses, found: {reason}; {cure}") from error


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
