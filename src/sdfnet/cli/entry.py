"""From the command line to a command: Hydra composes the settings, and a user's mistake becomes one clear message."""

import difflib
import importlib
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import CompactHydraException, HydraException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from sdfnet.cli.settings import CostSettings, EvaluateSettings, PrepareSettings, TrainSettings, VerifySettings
from sdfnet.errors import ConfigurationError, SdfnetError
from sdfnet.plugins import find_datasets, find_effects, frozen, register_datasets, register_effects, shipped, writable

Command = Callable[[Any, Path], float | None]

SCHEMAS: dict[str, type] = {
    "train": TrainSettings,
    "prepare": PrepareSettings,
    "evaluate": EvaluateSettings,
    "cost": CostSettings,
    "verify": VerifySettings,
}
HOMES = {"verify": "sdfnet.cli.verification"}  # where a command's function is; the others are in commands.py


def train() -> None:
    """python train.py: prepare what is missing, train, evaluate."""
    _main("train")


def prepare() -> None:
    """python prepare.py: only the data."""
    _main("prepare")


def evaluate() -> None:
    """python evaluate.py checkpoint=...: measure a checkpoint again."""
    _main("evaluate")


def cost() -> None:
    """python cost.py: what accuracy costs in time."""
    _main("cost")


def verify() -> None:
    """python verify.py: the reference cases beside their exact answers."""
    _main("verify")


def register() -> None:
    """Put the schemas, all datasets and all effects into Hydra's config store. Raises ConfigurationError for a broken plugin."""
    for name, schema in SCHEMAS.items():
        ConfigStore.instance().store(name=f"{name}_schema", node=writable(schema), provider="sdfnet")
    register_datasets(find_datasets())
    register_effects(find_effects())


def _main(name: str) -> None:
    def job(config: DictConfig) -> float | None:
        home = importlib.import_module(HOMES.get(name, "sdfnet.cli.commands"))  # late: composing and its errors do not wait for Lightning
        for chatty in ("skfem", "lightning.pytorch"):
            logging.getLogger(chatty).setLevel(logging.WARNING)
        command: Command = getattr(home, name)
        try:
            return command(frozen(config), Path(HydraConfig.get().runtime.output_dir))
        except SdfnetError as error:
            raise CompactHydraException(str(error)) from error  # Hydra prints it bare; HYDRA_FULL_ERROR=1 shows where it rose

    try:
        register()
        overrides = get_args_parser().parse_known_args(sys.argv[1:])[0].overrides
        check_overrides(name, overrides)
    except SdfnetError as error:
        sys.exit(f"{name}: {error}")
    hydra.main(config_path=str(shipped("conf")), config_name=name, version_base="1.3")(job)()


def check_overrides(name: str, overrides: list[str]) -> None:
    """Compose once before Hydra does, so that a mistake can be answered with the nearest name. Raises ConfigurationError."""
    try:
        first_of_sweeps = [line for override in OverridesParser.create().parse_overrides(overrides) for line in _first_of_sweep(override)]
        with hydra.initialize_config_dir(str(shipped("conf").resolve()), version_base="1.3"):
            hydra.compose(name, first_of_sweeps)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigurationError(_explained(error)) from error


def _first_of_sweep(override: Override) -> list[str]:
    """An override with the first of its values; none for a glob or an interval, which only Hydra can turn into values."""
    line = str(override.input_line)
    if not override.is_sweep_override():
        return [line]
    if not override.is_discrete_sweep() or override.value_type is ValueType.GLOB_CHOICE_SWEEP:
        return []
    return [f"{line.split('=', 1)[0]}={next(override.sweep_string_iterator())}"]


def _explained(error: Exception) -> str:
    """The error's own words, and for an unknown key the names that would have been known there."""
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    message = str(error).strip()
    if cause is not error and str(cause).splitlines()[0] not in message:
        message += "\n" + str(cause).splitlines()[0]
    parent, key = getattr(cause, "parent_node", None), getattr(cause, "key", None)
    if isinstance(cause, ConfigKeyError | ConfigAttributeError) and isinstance(parent, DictConfig) and isinstance(key, str):
        known = [str(one) for one in parent]
        nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
        message += f"\nDid you mean '{nearest[0]}'? " if nearest else "\n"
        message += f"Known here: {', '.join(known)}"
    return message
