"""An earlier run: its last checkpoint, and its settings, read beside that so that nobody has to type them again."""

import json
import re
import sys
from pathlib import Path

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf

from sdfnet.cli.screen import screen
from sdfnet.cost.sweep_table import overridden, overrides_alone


def typed() -> list[str]:
    """The overrides on the command line. Exits with argparse's words for an option that Hydra does not have."""
    return list(get_args_parser().parse_args(sys.argv[1:]).overrides)


def take_over(name: str) -> None:
    """Put the settings of the run that `resume` or `checkpoint` names before those that are typed, which win; say which they are."""
    overrides = typed()
    setting = {"train": "resume", "evaluate": "checkpoint"}.get(name)
    given = [line for line in overrides if overridden(line) == setting]
    try:
        checkpoint = OverridesParser.create().parse_override(given[-1]).value() if given else ""
    except HydraException:  # the command is refused with the reason when it is composed
        return
    if not isinstance(checkpoint, str) or not checkpoint:  # null, nothing, or several of a sweep
        return
    settings = Path(checkpoint).parent.parent / ".hydra"
    if not settings.is_dir():
        return
    offered = typed_for(settings) if name == "train" else measured_with(settings)
    taken = [line for line in offered if overridden(line) not in {"resume", *map(overridden, overrides)}]
    if taken:
        place = sys.argv.index(overrides[0])
        sys.argv[place:place] = taken
        screen().print(f"taken from the run in {settings.parent}: {' '.join(taken)}")


def typed_for(settings: Path) -> list[str]:
    """What was typed for a run, to be given to one run alone; `settings` is its folder .hydra."""
    words = OmegaConf.to_container(OmegaConf.load(settings / "overrides.yaml"))  # interpolations as they were typed
    assert isinstance(words, list)
    return list(overrides_alone(words))


def measured_with(settings: Path) -> list[str]:
    """How a run was evaluated, and where its data are, as overrides."""
    run = OmegaConf.to_container(OmegaConf.load(settings / "config.yaml"))
    assert isinstance(run, dict)
    return [f"evaluation.{name}={json.dumps(value)}" for name, value in run["evaluation"].items()] + [f"data_folder={json.dumps(run['data_folder'])}"]


def last_checkpoint(folder: Path) -> Path | None:
    """The checkpoint from which the run in a folder goes on: of its end, else the newest on the way."""
    paths = (folder / "checkpoints" / name for name in ("last.ckpt", "latest.ckpt"))
    return next((path for path in paths if path.is_file()), None)


def quoted(path: Path) -> str:
    """A path as the value of an override; in quotes where Hydra would read signs such as `=` and `,` as its own."""
    text = str(path)
    return text if re.fullmatch(r"[\w.+-]*/[\w./+-]*", text, re.ASCII) else "'" + text.replace("'", r"\'") + "'"
