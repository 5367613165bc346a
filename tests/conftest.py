"""Shapes and types are checked at run time in every test, and tests never share a working folder."""

import importlib
import os
from pathlib import Path

import pytest
import torch
from jaxtyping import install_import_hook

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run side by side; two thread pools on two cores wait for each other
importlib.import_module("sdfnet.geometry.distance_kernel")  # in Warp's own type language, which beartype cannot read
install_import_hook("sdfnet", "beartype.beartype")


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative paths, outputs/ above all, lead into the test's own folder; random weights are the same each time."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
