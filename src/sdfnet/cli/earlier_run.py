"""The settings of an earlier run, read beside its checkpoint, so that nobody has to type them again."""

import json
import sys
from pathlib import Path

from hydra._internal.utils import get_args_parser
from omegaconf import OmegaConf

from sdfnet.cli.screen import screen


def typed() -> list[str]:
    """The overrides on the command line."""
    return list(get_args_parser().parse_known_args(sys.argv[1:])[0].overrides)


def take_over(name: str) -> None:
    """Put the settings of the run that `resume` or `checkpoint` names before those that are typed, which win; say which they are."""
    overrides = typed()
    given = {key_of(line): line.split("=", 1)[1] for line in overrides if "=" in line}
    checkpoint = given.get({"train": "resume", "evaluate": "checkpoint"}.get(name, ""), "null").strip("'\"")
    settings = Path(checkpoint).parent.parent / ".hydra"
    if checkpoint in ("", "null") or not settings.is_dir():
        return
    offered = typed_for(settings) if name == "train" else measured_with(settings)
    taken = [line for line in offered if key_of(line) not in {"resume", *map(key_of, overrides)}]
    if taken:
        sys.argv[sys.argv.index(overrides[0]) : 0] = taken
        screen().print(f"taken from the run in {settings.parent}: {' '.join(taken)}")


def typed_for(settings: Path) -> list[str]:
    """What was typed for a run; `settings` is its folder .hydra. A page that makes a sweep of every command must not make one of a job that goes on."""
    lines = list(OmegaConf.load(settings / "overrides.yaml"))
    return [*lines, *(["hydra.mode=RUN"] if "sweep" in map(key_of, lines) else [])]


def measured_with(settings: Path) -> list[str]:
    """How a run was evaluated, and where its data are, as overrides."""
    run = OmegaConf.to_container(OmegaConf.load(settings / "config.yaml"))
    assert isinstance(run, dict)
    return [f"evaluation.{name}={json.dumps(value)}" for name, value in run["evaluation"].items()] + [f"data_folder={json.dumps(run['data_folder'])}"]


def key_of(override: str) -> str:
    """`model.width` of `model.width=64`, `effect@weight` of `+effect@weight=gravity`."""
    return override.split("=", 1)[0].lstrip("+~")
