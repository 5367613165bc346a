"""Where a sweep keeps its jobs, and which they are, before Hydra runs them."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sdfnet.cost.sweep_table import Target, changes_result, overridden
from sdfnet.errors import ConfigurationError
from sdfnet.plugins import shipped

LONGEST_NAME = 100  # letters of a folder's name; file systems allow 255 bytes


def folder_of_sweep(composed: DictConfig, overrides: Sequence[str]) -> Path:
    """The one that was typed, its interpolations filled in once for all processes; else one named by what was typed."""
    if not any(overridden(override) == "hydra.sweep.dir" for override in overrides):
        return Path(f"outputs/sweep/{folder_name(overrides)}")
    try:
        return Path(composed.hydra.sweep.dir)
    except OmegaConfBaseException as error:
        raise ConfigurationError(f"hydra.sweep.dir must be one folder for all jobs, found one that is not known yet ({error}); choose another") from error


def planned_jobs(composed: DictConfig, overrides: Sequence[str]) -> list[list[str]] | None:
    """The overrides of every job where Hydra's own sweeper tries all combinations; None of a sweeper that chooses as it goes."""
    if not composed.hydra.sweeper._target_.endswith(".BasicSweeper"):
        return None
    of_page = [f"{key}={value}" for key, value in (composed.hydra.sweeper.params or {}).items()]
    of_jobs = [override for override in overrides if not overridden(override).startswith(("hydra.", "hydra/"))]
    try:
        with hydra.initialize_config_dir(str(shipped("conf").resolve()), version_base="1.3"):
            parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
            (jobs,) = BasicSweeper.split_arguments(parser.parse_overrides([*of_page, *of_jobs]), None)
    except HydraException as error:
        raise ConfigurationError(str(error)) from error
    return jobs


def require_objectives(composed: DictConfig, target: Target) -> None:
    """Raise ConfigurationError when a sweeper that is told in which direction each objective is better is given more or fewer objectives."""
    direction = composed.hydra.sweeper.get("direction")
    wanted = len(direction) if OmegaConf.is_list(direction) else 1
    if direction is not None and wanted != len(target.objectives):
        raise ConfigurationError(
            f"target.objectives must name as many entries as hydra.sweeper.direction, {wanted}; found {len(target.objectives)}: {', '.join(target.objectives)}"
        )


def folder_name(overrides: Sequence[str]) -> str:
    """The overrides as the name of a folder that Hydra takes without quotes; of an override given twice the last one, as Hydra does.

    Each sign that it cannot hold becomes `-`. Where that could give two settings one name, or the name is too long, a hash tells them apart.
    """
    last = {overridden(override): override for override in overrides if changes_result(override)}
    asked = "_".join(last.values()) or "defaults"
    name = re.sub(r"[^\w.+-]", "-", asked, flags=re.ASCII)
    if name == asked.replace("=", "-") and "-" not in asked and len(name) <= LONGEST_NAME:
        return name
    return f"{name[: LONGEST_NAME - 8]}-{hashlib.sha256(asked.encode()).hexdigest()[:7]}"
