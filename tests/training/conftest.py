"""Short trainings on data that are prepared once."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sdfnet.data.prepare import prepare
from sdfnet.training.module import SdfTraining
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from tests.training.short_run import BALL, BOTH, PAIRS, Run, Start


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The prepared data of the ball."""
    made = tmp_path_factory.mktemp("data")
    prepare(BALL, made)
    return made


@pytest.fixture
def start(folder: Path, readings: Callable[[], Any]) -> Start:
    """`start(batch, training, optimizer, **trainer)`: a run that waits for `fit`."""

    def run(*settings: Any, **trainer: Any) -> Run:
        return Run(folder, readings(), *settings, **trainer)

    return run


@pytest.fixture
def first_weights(start: Start) -> SdfTraining:
    """A module with the weights that every run begins with."""
    run = start(PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings())
    run.family.setup("fit")
    run.module.configure_model()
    return run.module
