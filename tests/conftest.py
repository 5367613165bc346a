"""Shapes and types are checked at run time in every test, and tests never share a working folder."""

import importlib
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from jaxtyping import install_import_hook
from torch import Tensor

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run side by side; two thread pools on two cores wait for each other
importlib.import_module("sdfnet.geometry.distance_kernel")  # in Warp's own type language, which beartype cannot read
importlib.import_module("sdfnet.geometry.self_intersection_kernel")  # likewise
install_import_hook("sdfnet", "beartype.beartype")


LONG = ("verification", "runs", "cost")  # folders whose tests begin first, so that no worker ends with a long one while the others wait


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long tests first; otherwise in order."""
    items.sort(key=lambda item: item.path.parent.name not in LONG)


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative paths, outputs/ above all, lead into the test's own folder; random weights are the same each time."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _hydra_as_users_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mistakes end in a line and an exit code, also where coverage's tracing looks like a debugger to Hydra."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr("hydra._internal.utils.is_under_debugger", lambda: False)


@pytest.fixture(autouse=True)
def _own_log() -> Iterator[None]:
    """Hydra gives the root logger a level and handlers for good; the next test has those of before, whatever the order."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    yield
    root.setLevel(level)
    for handler in [one for one in root.handlers if one not in handlers]:
        root.removeHandler(handler)
        handler.close()


@pytest.fixture(scope="session")
def readings() -> Callable[[], Any]:
    """`readings()` is a new logger for Lightning that keeps what is logged: `of_epoch[3]["rate/encoder"]`."""
    from lightning.pytorch.loggers import Logger  # late: most tests do without Lightning

    class Readings(Logger):
        def __init__(self) -> None:
            super().__init__()
            self.of_epoch: dict[int, dict[str, float]] = {}

        @property
        def name(self) -> str:
            return "readings"

        @property
        def version(self) -> int:
            return 0

        def log_hyperparams(self, *arguments: Any, **named: Any) -> None:
            """There is nothing to keep."""

        def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
            assert step is not None
            self.of_epoch[step] = dict(metrics)

    return Readings


@pytest.fixture(scope="session")
def equal() -> Callable[[Any, Any], bool]:
    """Whether two values are bit-equal, through dictionaries and lists."""

    def compare(first: Any, second: Any) -> bool:
        if isinstance(first, Tensor):
            return torch.equal(first, second)
        if isinstance(first, Mapping):
            return first.keys() == second.keys() and all(compare(first[key], second[key]) for key in first)
        if isinstance(first, list | tuple):
            return len(first) == len(second) and all(compare(one, other) for one, other in zip(first, second, strict=True))
        return bool(first == second)

    return compare


@pytest.fixture
def clean_store(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Datasets and effects that a test registers with Hydra are gone after it."""
    from hydra.core.config_store import ConfigStore  # late: most tests do without Hydra

    kept = {key: value for key, value in ConfigStore.instance().repo.items() if key not in ("dataset", "effect")}
    monkeypatch.setattr(ConfigStore.instance(), "repo", kept)
    loaded = set(sys.modules)
    yield
    for name in set(sys.modules) - loaded:
        if name.startswith("sdfnet_dataset_plugins"):
            del sys.modules[name]
