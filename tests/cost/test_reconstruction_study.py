"""Grids from coarse to fine: the error falls with the square of the spacing, both ways are timed on one grid."""

import math
from itertools import pairwise

import pytest
import torch

from sdfnet.cost import reconstruction_study as module
from sdfnet.cost.reconstruction_study import QUICK_RESOLUTIONS, REPEATS, WAYS, reconstruction_study
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.evaluation.sparse_network import SparseReconstruction
from sdfnet.geometry.surface import Surface
from tests.cost.conftest import ball_networks


def test_error_of_the_grid_falls_with_the_square_of_its_spacing(ball_family: ShapeFamily) -> None:
    study = reconstruction_study(ball_networks(ball_family), ball_family.trajectory, ball_family.samples, quick=True)
    sparse = [point for point in study.points if point.method == "sparse"]
    whole = [point for point in study.points if point.method == "whole grid"]
    assert [point.setting for point in sparse] == [f"{resolution}^3" for resolution in QUICK_RESOLUTIONS]
    assert all(point.is_measured for point in study.points)
    coarse, fine = sparse[0].pair[0], sparse[-1].pair[0]
    order = math.log(coarse / fine) / math.log((QUICK_RESOLUTIONS[-1] - 1) / (QUICK_RESOLUTIONS[0] - 1))
    assert 1.5 < order < 2.5  # second order on a smooth surface; the ball has facets
    assert [point.pair[0] for point in sparse] == [point.pair[0] for point in whole]
    for few, all_points, resolution in zip(sparse, whole, QUICK_RESOLUTIONS, strict=True):
        assert all_points.counts["network queries"] == resolution**3
        assert few.counts["network queries"] < resolution**3
    assert [point.setting for point in study.points if point.is_default] == ["100^3"]
    assert [point.overrides for point in sparse] == [(f"evaluation.resolution={resolution}",) for resolution in QUICK_RESOLUTIONS]
    assert not any(point.overrides for point in whole), "no command can be told to take the whole grid"
    assert study.share_of_whole == pytest.approx(1 / len(ball_family.trajectory.times))


def test_network_without_a_surface_is_a_failed_point_at_every_resolution(ball_family: ShapeFamily) -> None:
    networks = ball_networks(ball_family)
    with torch.no_grad():
        networks.decoder.from_latent.bias.fill_(5.0)
    study = reconstruction_study(networks, ball_family.trajectory, ball_family.samples, quick=True)
    assert [(point.method, point.setting) for point in study.points] == [(way, f"{resolution}^3") for resolution in QUICK_RESOLUTIONS for way in WAYS]
    assert all(point.failure is not None and "both sides of zero" in point.failure for point in study.points)


def test_each_timing_is_of_another_frame_and_large_whole_grids_are_measured_too(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    networks, trajectory = ball_networks(ball_family), ball_family.trajectory
    asked: list[torch.Tensor] = []
    surface = SparseReconstruction.surface

    def recorded(sparse: SparseReconstruction, latent: torch.Tensor) -> Surface:
        asked.append(latent)
        return surface(sparse, latent)

    monkeypatch.setattr(SparseReconstruction, "surface", recorded)
    monkeypatch.setattr(module, "QUICK_RESOLUTIONS", (16, 24))
    monkeypatch.setattr(module, "DEAR_RESOLUTION", 16)
    monkeypatch.setattr(module, "SURFACE_SAMPLES", 500)
    monkeypatch.setattr(module, "LEAST_SECONDS", 0.0)
    study = reconstruction_study(networks, trajectory, ball_family.samples, quick=True)
    latents = networks.latents(torch.from_numpy(trajectory.surface_vertices).float())
    torch.testing.assert_close(torch.stack(asked[: REPEATS + 1]), latents.flip(0)[: REPEATS + 1], rtol=0, atol=0)
    assert not any(torch.equal(one, other) for one, other in pairwise(asked[: REPEATS + 1]))
    assert [(point.method, point.setting, point.seconds and point.seconds.repeats) for point in study.points] == [
        ("sparse", "16^3", 5), ("whole grid", "16^3", 5), ("sparse", "24^3", 2), ("whole grid", "24^3", 2)
    ]  # fmt: skip
