"""One query of everything that answers: the same answers in every batch, on any number of cores, and their errors."""

import re
import sys
import time

import numpy as np
import pytest
import torch

from sdfnet.cost import query_study as study_module
from sdfnet.cost.query_study import REFERENCE, _answers, available_cores, on_cores, query_seconds, query_study
from sdfnet.data.store import DistanceSamples
from sdfnet.errors import ConfigurationError
from sdfnet.models.networks import Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.trajectory import Trajectory

EXACT_MM = 1e-4  # float32 answers about a solid of 10 cm: 1e-5 mm of rounding, and that of the point of the query


@pytest.fixture(scope="module")
def networks(trajectory: Trajectory, samples: DistanceSamples) -> Networks:
    """Untrained networks."""
    lower, upper = (torch.from_numpy(corner).float() for corner in (samples.box.lower, samples.box.upper))
    return Networks(ModelSettings(width=8, depth=1, latent=2), torch.from_numpy(trajectory.surface_vertices.astype(np.float32)), lower, upper)


def test_an_answer_does_not_depend_on_the_batch_or_the_cores(networks: Networks, trajectory: Trajectory, samples: DistanceSamples) -> None:
    answers = _answers(networks, trajectory, samples, 2)
    points = torch.from_numpy(samples.near_points[::40].copy())  # on both sides of the surface
    for method, answer in answers.items():
        whole = answer(points)
        one_by_one = torch.cat([answer(point[None]) for point in points])
        torch.testing.assert_close(one_by_one, whole, rtol=0, atol=1e-8)
        with on_cores(1):
            assert torch.equal(answer(points), whole), method


def test_study_has_every_method_and_batch_and_exact_queries_have_no_error(
    networks: Networks, trajectory: Trajectory, samples: DistanceSamples, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_module, "BATCHES", (1, 100))
    monkeypatch.setattr(study_module, "CORES", (1,))
    points = query_study(networks, trajectory, samples).points
    assert {(point.method, point.counts["queries"]) for point in points} == {
        (f"{method}, 1 core", batch)
        for method in ("network", "Warp, mesh", "Warp, mesh refitted for each batch", "libigl, mesh", "KNN-1")
        for batch in (1, 100)
    }
    for point in points:
        assert point.is_measured
        assert point.error_mm is not None
        assert (point.error_mm < EXACT_MM) == (" mesh" in point.method), point
        assert point.error_mm > 0, "an answer in float32 differs from the truth in float64, sdfnet's own too"
        assert point.is_reference == point.method.startswith(REFERENCE)


def test_seconds_are_those_of_one_query() -> None:
    asked: list[int] = []

    def answer(points: torch.Tensor) -> torch.Tensor:
        asked.append(len(points))
        time.sleep(1e-3)
        return points[:, 0]

    found = query_seconds({"any": answer}, torch.rand(7, 3), (1, 1000), repeats=1)
    assert asked == 2 * (200 * [1] + 20 * [1000]), "a warm-up and a repeat; few points are repeated"
    # A call takes 1 ms, and on a busy machine some more; without the division it would be 200 or 20 times as much and more.
    assert 1e-3 <= found["any", 1].median < 0.1
    assert 1e-6 <= found["any", 1000].median < 1e-4


def test_cores_are_held_and_given_back() -> None:
    before, threads = available_cores(), torch.get_num_threads()
    with on_cores(1):
        assert (len(available_cores()), torch.get_num_threads()) == (1, 1)
    assert (available_cores(), torch.get_num_threads()) == (before, threads)
    with pytest.raises(ConfigurationError, match=f"as many, found {len(before)}"), on_cores(len(before) + 1):
        pass


def test_without_libigl_there_is_no_reference(networks: Networks, trajectory: Trajectory, samples: DistanceSamples, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(ConfigurationError, match=re.escape("this method needs libigl, which could not be imported; pip install libigl")):
        query_study(networks, trajectory, samples)
