"""Runs a command as a user would, in this process."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from sdfnet.cli import entry

Run = Callable[..., None]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Run:
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
