"""A mistake on the command line becomes one message with the cure."""

import difflib
import re
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from sdfnet.errors import ConfigurationError
from sdfnet.plugins import shipped

CHOICE = re.compile(r"must be one of (?P<known>.+?); found '(?P<found>.*?)'")  # how settings refuse a word
NO_LIST = re.compile(r"is not a ListConfig, list or tuple|=\(")  # OmegaConf's words, or what Hydra cannot parse
TAKEN = re.compile(r"In 'effect/(?P<kind>[^']+)'.*Merge error: \w+ is not a subclass of (?P<there>\w+)", re.DOTALL)
WRITTEN_FOLDERS = {"train": {"data_folder"}, "prepare": {"data_folder"}, "cost": {"data_folder"}}  # by command; besides Hydra's
HYDRA_FOLDERS = {"hydra.run.dir", "hydra.sweep.dir"}
PAGES = {"experiment", "sweep", "strategy"}  # groups of train.py that are no setting


def check_overrides(name: str, overrides: list[str]) -> DictConfig:
    """Compose once before Hydra does, so that a mistake can be answered with the nearest name. Raises ConfigurationError."""
    first_of_sweeps: list[str] = []
    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
        first_of_sweeps = [line for override in parsed for line in _first_of_sweep(override)]
        with hydra.initialize_config_dir(str(shipped("conf").resolve()), version_base="1.3"):
            composed = hydra.compose(name, first_of_sweeps, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # the last for dataset=null
        raise ConfigurationError(_explained(error, first_of_sweeps)) from error
    for override in parsed:
        if override.key_or_group in WRITTEN_FOLDERS.get(name, set()) | HYDRA_FOLDERS and not override.is_sweep_override():
            _require_folder(override.key_or_group, str(override.value()))
    return composed


def check_words(schema: type, words: list[str]) -> None:
    """Answer `--experiment smoke`, which Hydra takes for an option of its own. Raises ConfigurationError."""
    known = {entry.name for entry in fields(schema)} | PAGES
    for word, following in zip(words, [*words, "..."][1:], strict=True):
        key, _, value = word.lstrip("-").partition("=")
        if word.startswith("--") and re.split(r"[.@]", key)[0] in known:
            raise ConfigurationError(f"a setting is given without dashes and with =, found '{word}'; say {key}={value or following}")


def stored(group: str) -> list[str]:
    """The names that plugins have in a group, or in a group in a group."""
    entries = ConfigStore.instance().repo
    for part in group.split("/"):
        entries = entries.get(part, {})
    return sorted(name.removesuffix(".yaml") for name in entries if name.endswith(".yaml"))


def with_nearest(message: str) -> str:
    """A message, and where it refuses a word of several known ones the nearest of them."""
    choice = CHOICE.search(message)
    return message if choice is None else message + _guess(choice["found"], choice["known"].split(", "))


def _require_folder(key: str, place: str) -> None:
    """Make a folder that was typed; one with an interpolation in it only Hydra can name."""
    if "${" in place:
        return
    if not place:
        raise ConfigurationError(f"{key} must be a folder, found nothing behind it; name one, or leave {key} out")
    try:
        Path(place).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"{key} must be a folder that can be made, found '{place}' ({error.strerror}); choose another") from error


def _first_of_sweep(override: Override) -> list[str]:
    """An override with the first of its values; none for a glob or an interval, which only Hydra can turn into values."""
    line = str(override.input_line)
    if not override.is_sweep_override():
        return [line]
    if not override.is_discrete_sweep() or override.value_type is ValueType.GLOB_CHOICE_SWEEP:
        return []
    return [f"{line.split('=', 1)[0]}={next(override.sweep_string_iterator())}"]


def _explained(error: Exception, lines: list[str]) -> str:
    """The error's own words, for an unknown key the names that would have been known there, for an unknown option the nearest.

    `lines` are the overrides; a clash of two classes names no key.
    """
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    message = str(error).strip()
    if isinstance(error, MissingConfigException) and error.missing_cfg_file == "hydra/sweeper/optuna":
        return "sweep=search needs Optuna, found that it is not installed: pip install 'sdfnet[search]'"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, wrong = error.missing_cfg_file.rpartition("/")
        inner = [name for name in stored(group) if name not in error.options]  # of a group in a group, such as effect/pinned, Hydra lists the outer alone
        return message + (f"\nAvailable options in '{group}': {', '.join(inner)}" if inner else "") + _guess(wrong, inner or error.options)
    if cause is not error and str(cause).splitlines()[0] not in message:
        message += "\n" + str(cause).splitlines()[0]
    if NO_LIST.search(message):
        message += "\nA list is written in brackets and, because of the shell, in quotes: 'key=[1,2,3]'"
    taken = TAKEN.search(message)
    if taken and all(".effects." in line for line in lines if line.endswith(f"={taken['kind']}")):
        message += f"\nThere is a {taken['there']} of that name already: give another name, and if need be remove the old one with ~dataset.scene.effects.NAME"
    parent, key = getattr(cause, "parent_node", None), getattr(cause, "key", None)
    if isinstance(cause, ConfigKeyError | ConfigAttributeError) and isinstance(parent, DictConfig) and isinstance(key, str):
        known = [str(one) for one in parent]
        guess = _guess(key, known)
        message += f"{guess} " if guess else "\n"
        message += f"Known here: {', '.join(known)}"
    return message


def _guess(found: str, known: Iterable[str]) -> str:
    nearest = difflib.get_close_matches(found, list(known), n=1, cutoff=0.5)
    return f"\nDid you mean '{nearest[0]}'?" if nearest else ""
