"""The Python files and packages that plugins are in, and the classes that they define.

A dataset plugin is a file in a folder named `datasets` or a module named by an entry point of the group `sdfnet.datasets`;
a module named by an entry point of the group `sdfnet.effects` defines effects, sdfnet's own among them.
"""

import hashlib
import importlib.metadata
import inspect
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from sdfnet.errors import ConfigurationError
from sdfnet.scene import Effect

Kind = TypeVar("Kind")

DATASETS_GROUP, EFFECTS_GROUP = "sdfnet.datasets", "sdfnet.effects"  # of entry points
OWN_EFFECTS = "sdfnet.physics.effects."
WORD_START = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
# Plugin files are loaded under this package, so that a folder named datasets never shadows another package of that name.
PLUGIN_PACKAGE = "sdfnet_dataset_plugins"


def dataset_modules(folders: Iterable[Path]) -> list[ModuleType]:
    """The files of the folders, then the modules of the entry points. Raises ConfigurationError for a broken one."""
    # By name and content: an installed sdfnet that runs inside a checkout sees the same files twice, and means them once.
    files = {(path.name, path.read_bytes()): path.resolve() for folder in folders if folder.is_dir() for path in sorted(folder.glob("*.py"))}
    return [*(_loaded_file(path) for path in sorted(files.values())), *_entry_point_modules(DATASETS_GROUP, "dataset")]


def effect_modules() -> list[ModuleType]:
    """The modules of the entry points. Raises ConfigurationError for one that is broken or defines no effect, and when sdfnet's own are not among them."""
    modules = _entry_point_modules(EFFECTS_GROUP, "effect")
    if not any(module.__name__.startswith(OWN_EFFECTS) for module in modules):
        raise ConfigurationError(
            f"sdfnet's own effects must be among the entry points of the group {EFFECTS_GROUP}, found none: "
            "it was installed before it had them; install it again, in a checkout with pip install --editable ."
        )
    for module in modules:
        if not _kinds_of(module, Effect):
            raise ConfigurationError(f"effect plugin '{module.__name__}' must define an effect, found none in '{origin_of(module)}'; mend or uninstall it")
    return modules


def _kinds_of(module: ModuleType, base: type[Kind]) -> list[type[Kind]]:
    kinds = [kind for kind in vars(module).values() if inspect.isclass(kind) and issubclass(kind, base) and belongs_to(kind, module)]
    return [kind for kind in kinds if not inspect.isabstract(kind) and not kind.__name__.startswith("_")]


def classes_by_name(base: type[Kind], modules: Iterable[ModuleType], known: Mapping[str, type[Kind]]) -> dict[str, type[Kind]]:
    """The known classes, and every one that the modules derive from `base`, `PressurePoke` as `pressure_poke`.

    Abstract ones and those that begin with an underscore are left out. Raises ConfigurationError when two have one name.
    """
    found = dict(known)
    for kind in (kind for module in modules for kind in _kinds_of(module, base)):
        name = WORD_START.sub("_", kind.__name__).lower()
        if found.setdefault(name, kind) is not kind:
            first, second = (origin_of(sys.modules[one.__module__]) for one in (found[name], kind))
            raise ConfigurationError(f"two plugins define the {base.__name__} '{name}': '{first}' and '{second}'; rename one")
    return found


def belongs_to(thing: Any, module: ModuleType) -> bool:
    """Whether it was defined in the module or in a part of it, and not only imported there."""
    return f"{thing.__module__}.".startswith(f"{module.__name__}.")


def origin_of(module: ModuleType) -> Path:
    """The file of a module."""
    return Path(str(module.__file__)).resolve()


def _loaded_file(path: Path) -> ModuleType:
    """The module of a file; asked again it is the same one, so that a class of it stays one class."""
    # Two folders may hold files of one name, and a file may change while a notebook runs.
    name = f"{PLUGIN_PACKAGE}.{path.stem}_{hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    module = sys.modules[name] = ModuleType(name)
    module.__file__ = str(path)
    try:  # not by an import loader: Python's compiled copy is of any file of that name, size and second
        exec(compile(path.read_bytes(), path, "exec"), vars(module))
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
