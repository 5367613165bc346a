"""From the command line to a command: Hydra composes the settings, and a user's mistake becomes one clear message."""

import importlib
import logging
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from sdfnet.cli.earlier_run import last_checkpoint, quoted, take_over, typed
from sdfnet.cli.mistakes import check_overrides, check_words, stored, with_nearest
from sdfnet.cli.settings import CostSettings, EvaluateSettings, PrepareSettings, TrainSettings, VerifySettings
from sdfnet.errors import SdfnetError
from sdfnet.physics.regions import REGIONS, Region
from sdfnet.plugins import find_datasets, find_effects, find_kinds, frozen, register_datasets, register_effects, shipped, writable
from sdfnet.stopping import Stopped, signals_handled

Command = Callable[[Any, Path], float | None]

SCHEMAS: dict[str, type] = {
    "train": TrainSettings,
    "prepare": PrepareSettings,
    "evaluate": EvaluateSettings,
    "cost": CostSettings,
    "verify": VerifySettings,
}
HOMES = {"verify": "sdfnet.cli.verification", "cost": "sdfnet.cli.costs"}  # where a command's function is; the others are in commands.py


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


def register(*commands: str) -> None:
    """Put the schemas of these commands, all datasets and all effects into Hydra's config store. Raises ConfigurationError for a broken plugin."""
    # Hydra copies the whole store for every group that it looks at, though it only reads it: --help took seconds longer.
    ConfigStore.__deepcopy__ = lambda store, memo: store  # type: ignore[attr-defined]
    for command in commands:
        ConfigStore.instance().store(name=f"{command}_schema", node=writable(SCHEMAS[command]), provider="sdfnet")
    register_datasets(find_datasets())
    register_effects(find_effects(), {Region: find_kinds(Region, known=REGIONS)})
    OmegaConf.register_new_resolver("known", _known, replace=True)  # for the pages that --help shows


def _known(group: str) -> str:
    """The names of a group: of files in conf/, and of plugins."""
    files = (path.stem for path in (shipped("conf") / group).glob("*.yaml"))
    return ", ".join(sorted({*files, *stored(group)}))


def _main(name: str) -> None:
    asked, is_sweep = sys.argv[1:], False

    def job(config: DictConfig) -> float | tuple[float, ...] | None:
        output = Path(HydraConfig.get().runtime.output_dir)
        try:
            if name == "train" and HydraConfig.get().mode is RunMode.MULTIRUN:
                return importlib.import_module("sdfnet.cli.sweep").run_job(config)
            home = importlib.import_module(HOMES.get(name, "sdfnet.cli.commands"))  # late: composing and its errors do not wait for Lightning
            for chatty in ("skfem", "lightning.pytorch"):  # Lightning sets its own when it is imported
                logging.getLogger(chatty).setLevel(logging.WARNING)
            command: Command = getattr(home, name)
            return command(frozen(config), output)
        except SdfnetError as error:
            _remove_if_empty(output, name)
            raise CompactHydraException(with_nearest(str(error))) from error  # Hydra prints it bare; HYDRA_FULL_ERROR=1 shows where it rose
        except Stopped as stopped:
            cure = _how_to_go_on(name, output, asked)
            _remove_if_empty(output, name)
            _say_stopped(name, cure)
            sys.exit(stopped.exit_code)

    try:
        with signals_handled():
            try:
                sys.argv[1:] = sorted(sys.argv[1:], key=lambda word: word in ("-m", "--multirun"))  # argparse takes no override behind them
                check_words(SCHEMAS[name], sys.argv[1:])
                register(name)
                take_over(name)
                composed = check_overrides(name, typed())
                start = hydra.main(config_path=str(shipped("conf")), config_name=name, version_base="1.3")(job)
                is_sweep = name == "train" and _asks_for_sweep(composed)
                if is_sweep:
                    importlib.import_module("sdfnet.cli.sweep").sweep(start, composed)
                else:
                    start()
            except SdfnetError as error:
                sys.exit(f"{name}: {with_nearest(str(error))}")
    except Stopped as stopped:  # before there was a run, or while a launcher's processes ran the jobs of a sweep
        if is_sweep:
            _say_stopped(name, _same_again(name, asked))
        sys.exit(stopped.exit_code)


def _asks_for_sweep(composed: DictConfig) -> bool:
    """Whether jobs are to be run, many of them: an option that only shows something runs none."""
    options = get_args_parser().parse_known_args(sys.argv[1:])[0]
    only_shows = options.help or options.hydra_help or options.shell_completion or options.cfg is not None or options.info is not None
    return not only_shows and (options.multirun or composed.hydra.mode is RunMode.MULTIRUN)


def _say_stopped(name: str, cure: str) -> None:
    Console(stderr=True, highlight=False, soft_wrap=True).print(f"{name}: stopped; {cure}", markup=False)


def _how_to_go_on(name: str, output: Path, asked: list[str]) -> str:
    """The command that continues a run that was stopped; `asked` is what was typed for it."""
    checkpoint = last_checkpoint(output)
    return _same_again(name, asked) if checkpoint is None else f"go on with: {shlex.join(['python', 'train.py', f'resume={quoted(checkpoint)}'])}"


def _same_again(name: str, asked: list[str]) -> str:
    kept = "what was finished is kept, and the same command goes on from there" if name in ("train", "prepare") else "the same command begins anew"
    return f"{kept}: {shlex.join(['python', f'{name}.py', *asked])}"


def _remove_if_empty(output: Path, name: str) -> None:
    """Take a run's folder away when nothing but Hydra has written to it."""
    ours = [path for path in output.rglob("*") if path.is_file() and path.parent.name != ".hydra" and path.name != f"{name}.log"]
    if not ours and output.resolve() != Path.cwd():
        shutil.rmtree(output)
