"""Every page in conf/ composes, and says what it should."""

import re
import shlex
from functools import cache
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from sdfnet.cli.entry import SCHEMAS, register
from sdfnet.cli.mistakes import check_overrides
from sdfnet.cli.settings import TrainerSettings
from sdfnet.evaluation.settings import EvaluationSettings
from sdfnet.models.decoder import SdfCalculator
from sdfnet.plugins import frozen, shipped
from tests.composition import composed

ROOT = Path(__file__).parents[1]


def _choices(group: str) -> list[str]:
    return [f"{group}={path.stem}" for path in sorted((shipped("conf") / group).glob("*.yaml"))]


@cache
def page(command: str, *overrides: str) -> DictConfig:
    """What a command composes, once for all tests."""
    return composed(command, *overrides)


COMMANDS = [
    ("train", []),
    *[("train", [choice]) for group in ("model", "batch", "optimizer", "training", "sweep", "experiment") for choice in _choices(group)],
    *[("train", [f"strategy=[{path.stem}]"]) for path in sorted((shipped("conf") / "strategy").glob("*.yaml"))],
    *[("train", [f"dataset={path.stem}"]) for path in sorted(shipped("datasets").glob("*.py"))],
    ("prepare", []),
    ("evaluate", ["checkpoint=some.ckpt"]),
    ("cost", ["dataset_name=any"]),  # else Hydra says it, when it runs
    ("verify", []),
]


@pytest.fixture(scope="module", autouse=True)
def _registered() -> None:
    register(*SCHEMAS)


@pytest.mark.parametrize(("command", "overrides"), COMMANDS, ids=[" ".join([command, *overrides]) for command, overrides in COMMANDS])
def test_every_shipped_page_composes_and_becomes_its_objects(command: str, overrides: list[str]) -> None:
    if overrides == ["sweep=search"]:
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="its sweeper comes with pip install 'sdfnet[search]'")
    config = page(command, *overrides)
    settings = frozen(config)
    assert type(settings).__name__ == f"{command.title()}Settings"
    assert not OmegaConf.missing_keys(config)
    for key in config:
        assert hasattr(settings, str(key))


def test_every_yaml_is_covered_by_the_commands() -> None:
    pages = {path.relative_to(shipped("conf")).with_suffix("").as_posix() for path in shipped("conf").rglob("*.yaml")}
    covered = {command for command, _ in COMMANDS} | {re.sub(r"=\[?|\]", "/", override).rstrip("/") for _, overrides in COMMANDS for override in overrides}
    assert pages <= covered


def test_every_command_that_is_written_down_can_be_typed(tmp_path: Path) -> None:
    texts = [path.read_text() for path in (*shipped("conf").rglob("*.yaml"), ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))]
    # What it does stands behind several spaces or after the quote's end; a line may go on in the next.
    found = [command for text in texts for command in re.findall(r"python (\w+)\.py((?: [^\s`]+)+)", text.replace("\\\n    ", ""))]
    commands = sorted({(name, words) for name, words in found if name in SCHEMAS and not re.search(r"\.\.\.|dataset=shelf|sweep=search", words)})
    assert len(commands) > 30
    for name, words in commands:
        check_overrides(name, [word for word in shlex.split(words) if word not in ("-m", "hydra.mode=RUN")])


def test_the_papers_experiment_has_the_papers_numbers() -> None:
    settings = frozen(page("train", "experiment=paper"))
    scene, sampling = settings.dataset.scene, settings.dataset.sampling
    assert (scene.solver.mass, scene.solver.integrator, scene.solver.time_step) == ("consistent", "symplectic_euler", 1e-6)
    assert (scene.recording.duration, scene.recording.frames) == (0.01, 101)
    assert (scene.material.youngs_modulus, scene.material.poisson_ratio, scene.material.density) == (5e3, 0.4, 1.0)
    assert (scene.effects["poke"].radius, scene.effects["poke"].pressure) == (0.003, 4000.0)
    assert (sampling.count, sampling.near_surface_count, sampling.box_scale, sampling.z_exponent, sampling.z_floor) == (1_000_000, 0, 1.5, 0.5, 0.001)
    assert (sampling.weight_outside, sampling.weight_inside, abs(sampling.decay)) == (0.8, 3.0, 10.0)
    assert (settings.model.width, settings.model.depth, settings.model.latent, settings.model.encoding) == (256, 3, 128, "none")
    assert (settings.optimizer.encoder_rate, settings.optimizer.decoder_rate) == (0.0075, 0.005)
    assert (settings.training.epochs, settings.batch.ordered_epochs, settings.batch.frames_per_step) == (592, 6, 2)
    assert [(phase.trains, phase.epochs) for phase in settings.training.cycle] == [("both", 7), ("encoder", 5), ("decoder", 12)]
    plateaus = [(one.first_epoch, one.last_epoch, one.patience, one.factor) for one in settings.optimizer.plateaus]
    assert plateaus == [(3, 19, 30, 0.92), (20, None, 2, 0.75)]


@pytest.mark.parametrize("name", ["siren", "hash_grid", "dense_grid", "modulated", "pod", "learned"])
def test_the_other_small_models_have_the_bytes_of_the_default(name: str) -> None:
    small, other = (SdfCalculator(frozen(page("train", f"model={one}")).model, torch.zeros(3), torch.ones(3)).parameter_count for one in ("small", name))
    assert small == 14_977
    assert other == pytest.approx(small, rel=0.025)  # a width more or less is as much


def test_the_menu_of_train_names_every_model() -> None:
    (line,) = [line for line in (shipped("conf") / "train.yaml").read_text().splitlines() if line.startswith("  - model:")]
    assert [path.stem for path in (shipped("conf") / "model").glob("*.yaml") if path.stem not in line.split("#")[1]] == []


def test_the_menu_of_train_shows_all_settings_of_trainer_and_evaluation_at_their_defaults() -> None:
    page = OmegaConf.to_container(OmegaConf.load(shipped("conf") / "train.yaml"))
    assert isinstance(page, dict)
    for name, defaults in (("trainer", TrainerSettings()), ("evaluation", EvaluationSettings())):
        shown = {key: tuple(value) if isinstance(value, list) else value for key, value in page[name].items()}
        assert shown == vars(defaults)
