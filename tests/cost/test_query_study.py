"""One query of everything that answers: the same answers in every batch, on any number of cores, and their errors."""

import sys
import time

import igl
import numpy as np
import pytest
import torch

from sdfnet.cost import query_study as study_module
from sdfnet.cost.distance_study import exact_distances
from sdfnet.cost.findings import front_of
from sdfnet.cost.machine import on_cores
from sdfnet.cost.query_study import LIBIGL, REBUILT_LIBIGL, _answers, query_seconds, query_studies
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


def test_each_batch_is_a_study_of_every_method_and_exact_queries_have_no_error(
    networks: Networks, trajectory: Trajectory, samples: DistanceSamples, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_module, "BATCHES", (1, 100))
    monkeypatch.setattr(study_module, "CORES", (1,))
    monkeypatch.setattr(study_module, "REPEATS", 1)
    monkeypatch.setattr(study_module, "MOST_CALLS", 2)
    studies = query_studies(networks, trajectory, samples)
    methods = ["network", "Warp, mesh", "Warp, mesh refitted for each batch", "KNN-1", LIBIGL]
    for study, batch, timed in zip(studies, (1, 100), (methods, [*methods, REBUILT_LIBIGL]), strict=True):
        assert (study.name, study.title) == (f"query_{batch}", f"One query in batches of {batch}")
        assert [(point.method, point.setting, point.counts["queries"]) for point in study.points] == [(method, "1 core", batch) for method in timed]
        assert any(point.method.startswith(LIBIGL) for point in front_of(study)), "the most accurate"
        assert all(f"{method} " in study.notes[0] for method in timed), "the seconds of what is on no front are said too"
    for point in [point for study in studies for point in study.points]:
        assert point.is_measured
        assert point.error_mm is not None
        assert (point.error_mm < EXACT_MM) == (" mesh" in point.method), point
        assert point.error_mm > 0, "an answer in float32 differs from the truth in float64, sdfnet's own too"


def test_seconds_are_those_of_one_query() -> None:
    asked: list[int] = []

    def answer(points: torch.Tensor) -> torch.Tensor:
        asked.append(len(points))
        time.sleep(1e-3)
        return points[:, 0]

    single, thousand = (query_seconds({"any": answer}, torch.rand(7, 3), batch, repeats=1)["any"].median for batch in (1, 1000))
    assert asked == 2 * 200 * [1] + 2 * 20 * [1000], "a warm-up and a repeat; few points are repeated"
    # A call takes 1 ms, and on a busy machine some more; without the division it would be 200 or 20 times as much and more.
    assert 1e-3 <= single < 0.1
    assert 1e-6 <= thousand < 1e-4


def test_libigls_trees_are_built_once_and_asked_by_every_batch(trajectory: Trajectory, samples: DistanceSamples, networks: Networks) -> None:
    answer = _answers(networks, trajectory, samples, 2)[LIBIGL]
    points = torch.from_numpy(samples.points)
    with pytest.MonkeyPatch.context() as patch:
        for builder in ("AABB", "FastWindingNumberBVH", "signed_distance"):
            patch.delattr(igl, builder)
        found = torch.cat([answer(points[:1]), answer(points[1:])])
    torch.testing.assert_close(found.double(), torch.from_numpy(exact_distances(points.numpy(), trajectory.surface(2))), rtol=0, atol=1e-8)


def test_without_libigl_there_is_no_reference(networks: Networks, trajectory: Trajectory, samples: DistanceSamples, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(ConfigurationError, match="this method needs libigl, which could not be imported .*; pip install 'sdfnet\\[cost]'"):
        query_studies(networks, trajectory, samples)
