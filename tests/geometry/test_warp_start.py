"""Warp's start, which must not look like an error on a machine without CUDA."""

import logging
import os

import pytest
import warp as wp

from sdfnet.geometry.warp_start import start_warp


def test_what_warp_prints_when_it_starts_is_kept_from_standard_error(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(wp, "init", lambda: os.write(2, b"Warp CUDA error: no driver\n"))
    start_warp.cache_clear()
    with caplog.at_level(logging.DEBUG, logger="sdfnet.geometry.warp_start"):
        start_warp()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
    assert caplog.messages == ["Warp printed: Warp CUDA error: no driver"]


def test_standard_error_is_given_back_when_warp_fails(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise RuntimeError("no library")

    monkeypatch.setattr(wp, "init", fail)
    start_warp.cache_clear()
    with pytest.raises(RuntimeError, match="no library"):
        start_warp()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
