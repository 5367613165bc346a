"""The machine that a study runs on: told by name, its cores lent and given back."""

from pathlib import Path

import pytest
import torch

from sdfnet.cost import machine as machine_module
from sdfnet.cost.machine import available_cores, machine, on_cores
from sdfnet.errors import ConfigurationError


def test_cores_are_held_and_given_back() -> None:
    before, threads = available_cores(), torch.get_num_threads()
    with on_cores(1):
        assert (len(available_cores()), torch.get_num_threads()) == (1, 1)
    assert (available_cores(), torch.get_num_threads()) == (before, threads)
    with pytest.raises(ConfigurationError, match=f"as many, found {len(before)}"), on_cores(len(before) + 1):
        pass


def test_machine_is_told_by_its_processors_name_and_cores(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    listed = tmp_path / "cpuinfo"
    listed.write_text("processor\t: 0\nmodel\t\t: 85\nmodel name\t: A Processor @ 2.00GHz\n")
    monkeypatch.setattr(machine_module, "CPU_FILE", listed)
    assert machine() == {"processor": "A Processor @ 2.00GHz", "cores": str(len(available_cores()))}
    listed.unlink()  # as on macOS
    assert machine()["processor"]
