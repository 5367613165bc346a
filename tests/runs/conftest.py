"""Runs a command as a user would, in this process; trains small networks that can be stopped and resumed."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra

from sdfnet.cli import entry
from sdfnet.data.prepare import prepare
from tests.runs.resumable_run import BALL, RECIPES, Outcome, Recipe, RequireSameEnd, Run, require_same_end, train


@pytest.fixture(scope="session", autouse=True)
def _effects_stored_once() -> Iterator[None]:
    """What commands of one process store of the same effects is made once: a third of the time of a command that ends early."""
    made: dict[str, object] = {}

    def stored(effects: dict[str, type], choices: dict[type, dict[str, type]]) -> None:
        groups = ConfigStore.instance().repo
        if made.get("of") != (effects, choices):
            groups.pop("effect", None)
            register_effects(effects, choices)
            made.update(of=(effects, choices), group=groups["effect"])
        groups["effect"] = made["group"]

    register_effects = entry.register_effects
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(entry, "register_effects", stored)
        yield


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`command("train", "experiment=smoke")`; raises SystemExit where the command fails."""

    def run(name: str, *words: str) -> None:
        GlobalHydra.instance().clear()
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
        getattr(entry, name)()

    return run


@pytest.fixture
def newest_result() -> Callable[[str], Path]:
    """The folder of the newest run under outputs/<name>."""

    def newest(name: str) -> Path:
        return max(Path("outputs", name).rglob("result.json"), key=lambda path: path.stat().st_mtime).parent

    return newest


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The prepared data of the ball."""
    made = tmp_path_factory.mktemp("data")
    prepare(BALL, made)
    return made


@pytest.fixture(scope="session")
def run(data: Path, readings: Callable[[], Any]) -> Run:
    """`run(recipe, checkpoints, resume=..., epochs=...)`: a training, to its end."""
    return lambda recipe, *folders, **settings: train(recipe, data, readings(), *folders, **settings)


@pytest.fixture(scope="session", params=RECIPES)
def recipe(request: pytest.FixtureRequest) -> Recipe:
    """Each recipe in turn."""
    return RECIPES[request.param]


@pytest.fixture(scope="session")
def whole(recipe: Recipe, run: Run, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The uninterrupted run, with a checkpoint after every step and every epoch."""
    return run(recipe, tmp_path_factory.mktemp("checkpoints"))


@pytest.fixture(scope="session")
def same_end(equal: Callable[[Any, Any], bool]) -> RequireSameEnd:
    """`same_end(resumed, whole, "epoch 3")` asserts that a resumed run took the steps that were left and ended in the same state."""
    return lambda resumed, whole, origin: require_same_end(resumed, whole, equal, origin)
