"""Preparation builds what is missing and nothing else, whole or not at all, once."""

import logging
import os
import threading
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch

import sdfnet.data.prepare
from sdfnet.data.prepare import PreparedFiles, deforming_distances, prepare, prepare_mesh, sample_distances
from sdfnet.data.store import read_distances, read_mesh, read_mesh_provenance, read_provenance, read_trajectory
from sdfnet.errors import ConfigurationError, GeometryError, StoreError
from sdfnet.geometry.distance import SurfaceDistance, signed_distance
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.simulate import simulate
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Dataset, Geometry, Recording, Sampling, Scene

STAGES = ("tet mesh", "simulation", "signed distances")
POKE = PressurePoke(center=(-0.05, 0.0, 0.0), radius=0.03, pressure=500.0)
SMALL = Dataset(
    Scene(Sphere(radius=0.05, cells=3), {"poke": POKE}, recording=Recording(duration=2e-4, frames=3)),
    Sampling(count=500, near_surface_count=200),
)
FOLDER = Path("data")


def _with_pressure(pressure: float) -> Dataset:
    return replace(SMALL, scene=replace(SMALL.scene, effects={"poke": replace(POKE, pressure=pressure)}))


def test_the_second_call_builds_nothing_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    first = prepare(SMALL, FOLDER)
    assert first.built == STAGES
    stamps = {path: path.stat().st_mtime_ns for path in FOLDER.iterdir() if not path.name.endswith(".lock")}
    with caplog.at_level(logging.INFO, logger="sdfnet"):
        second = prepare(SMALL, FOLDER)
    assert second == replace(first, built=())
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    assert "nothing to prepare: mesh, trajectory and distances are all in data" in caplog.messages


def test_a_folder_of_prepared_data_holds_named_whole_files_only() -> None:
    files = prepare(SMALL, FOLDER)
    visible = {path.name for path in FOLDER.iterdir() if not path.name.startswith(".")}
    mesh, trajectory = files.mesh.stem, files.trajectory.stem
    assert visible == {f"{mesh}.vtu", f"{mesh}.mesh", f"{mesh}.json", f"{trajectory}.h5", f"{trajectory}.xdmf", files.distances.name}
    assert all(path.name.endswith(".lock") for path in FOLDER.iterdir() if path.name.startswith("."))


def test_a_change_rebuilds_what_depends_on_it_and_nothing_left_of_it() -> None:
    first = prepare(SMALL, FOLDER)
    other_sampling = prepare(replace(SMALL, sampling=replace(SMALL.sampling, seed=1)), FOLDER)
    assert other_sampling.built == ("signed distances",)
    assert other_sampling.trajectory == first.trajectory
    other_effect = prepare(_with_pressure(600.0), FOLDER)
    assert other_effect.built == ("simulation", "signed distances")
    assert other_effect.mesh == first.mesh
    other_mesh = prepare(replace(SMALL, scene=replace(SMALL.scene, geometry=Sphere(radius=0.05, cells=4))), FOLDER)
    assert other_mesh.built == STAGES
    assert prepare(SMALL, FOLDER).built == ()  # the first files are all still there


@pytest.mark.parametrize(("deleted", "rebuilt"), [("mesh", STAGES[:1]), ("trajectory", STAGES[1:2]), ("distances", STAGES[2:])])
def test_one_deleted_file_is_made_again_alone(deleted: str, rebuilt: tuple[str, ...]) -> None:
    files = prepare(SMALL, FOLDER)
    getattr(files, deleted).unlink()
    assert prepare(SMALL, FOLDER).built == rebuilt  # the mesh comes back the same, so what was made from it keeps its name


def test_the_files_hold_what_the_stages_give_in_memory() -> None:
    files = prepare(SMALL, FOLDER)
    mesh = SMALL.scene.geometry.tet_mesh()  # type: ignore[attr-defined]
    trajectory = simulate(SMALL.scene, mesh)
    assert read_mesh(files.mesh).digest == mesh.digest
    np.testing.assert_array_equal(read_trajectory(files.trajectory).displacements, trajectory.displacements)
    samples, stored = sample_distances(trajectory, SMALL.sampling), read_distances(files.distances)
    for name in ("points", "distances", "kept", "near_points", "near_distances"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(samples, name))


def test_stored_distances_are_those_to_each_frames_own_surface() -> None:
    files = prepare(_with_pressure(2000.0), FOLDER)
    trajectory, samples = read_trajectory(files.trajectory), read_distances(files.distances)
    assert np.abs(trajectory.displacements[-1]).max() > 1e-4  # else the frames would not differ
    for frame in range(3):
        for points, distances in ((samples.points, samples.distances), (samples.near_points, samples.near_distances)):
            exact = signed_distance(torch.from_numpy(points), trajectory.surface(frame)).numpy()
            np.testing.assert_allclose(distances[frame], exact, atol=1e-7)  # float32 at 0.1 m: 7e-9


def test_a_solid_that_does_not_move_keeps_its_distances_even_on_the_surface() -> None:
    surface = Sphere(radius=0.05, cells=4).tet_mesh().surface()
    points = np.concatenate([surface.vertices, surface.vertices[surface.faces].mean(axis=1)]).astype(np.float32)
    distances = deforming_distances(points, np.repeat(surface.vertices[None], 3, axis=0), surface.faces)
    np.testing.assert_array_equal(distances[1:], distances[:1].repeat(2, axis=0))
    assert np.abs(distances).max() < 1e-8  # on the surface to float32


def test_the_hierarchy_is_built_once_and_refitted(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    original = SurfaceDistance.__init__

    def counted(self: SurfaceDistance, *arguments: object, **settings: object) -> None:
        made.append(1)
        original(self, *arguments, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(SurfaceDistance, "__init__", counted)
    surface = Sphere(cells=2).tet_mesh().surface()
    seen: list[int] = []
    deforming_distances(np.zeros((2, 3), dtype=np.float32), np.repeat(surface.vertices[None], 4, axis=0), surface.faces, after_frame=seen.append)
    assert made == [1]
    assert seen == [1, 2, 3, 4]


def test_progress_counts_every_frame_of_both_sets_of_points() -> None:
    seen: list[tuple[int, int]] = []
    mesh = Sphere(radius=0.05, cells=3).tet_mesh()
    sample_distances(simulate(SMALL.scene, mesh), SMALL.sampling, report=lambda done, total: seen.append((done, total)))
    assert seen == [(k, 6) for k in range(1, 7)]


def test_every_file_says_what_it_was_made_from_and_how_long_it_took() -> None:
    files = prepare(SMALL, FOLDER)
    mesh, trajectory, distances = read_mesh_provenance(files.mesh), read_provenance(files.trajectory), read_provenance(files.distances)
    assert mesh["geometry"] == {"kind": "Sphere", "radius": 0.05, "cells": 3}
    assert trajectory["mesh"] == read_mesh(files.mesh).digest
    assert trajectory["scene"]["effects"]["poke"]["pressure"] == 500.0
    assert distances["trajectory"] == files.trajectory.name
    assert distances["sampling"]["count"] == 500
    for stage, provenance in zip(STAGES, (mesh, trajectory, distances), strict=True):
        assert files.seconds[stage] == provenance["seconds"] > 0
        assert "warp-lang" in provenance["versions"]


def test_prepare_mesh_makes_the_mesh_alone_and_prepare_takes_it_over() -> None:
    mesh = prepare_mesh(SMALL, FOLDER)
    assert isinstance(mesh, TetMesh)
    assert not list(FOLDER.glob("*.h5"))
    assert prepare(SMALL, FOLDER).built == STAGES[1:]


def test_a_geometry_that_makes_no_mesh_is_named() -> None:
    with pytest.raises(ConfigurationError, match="scene.geometry must derive from MeshedGeometry, found Geometry"):
        prepare(replace(SMALL, scene=replace(SMALL.scene, geometry=Geometry())), FOLDER)


def test_a_stage_that_fails_leaves_no_file_and_the_next_run_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> None:
        raise StoreError("no")

    with monkeypatch.context() as patch:
        patch.setattr(sdfnet.data.prepare, "keep_per_frame", broken)
        with pytest.raises(StoreError, match="no"):
            prepare(SMALL, FOLDER)
    assert [path.name for path in FOLDER.glob("*distances*") if not path.name.endswith(".lock")] == []
    assert prepare(SMALL, FOLDER).built == ("signed distances",)


def test_a_truncated_file_is_named_and_not_used() -> None:
    files = prepare(SMALL, FOLDER)
    files.trajectory.write_bytes(files.trajectory.read_bytes()[:-1000])
    files.distances.unlink()
    with pytest.raises(StoreError, match=f"'{files.trajectory}' is truncated.*delete it and it is made again"):
        prepare(SMALL, FOLDER)
    files.trajectory.unlink()
    assert prepare(SMALL, FOLDER).built == STAGES[1:]


def _killed_while_writing(folder: str) -> None:
    def die(*arguments: object) -> None:
        os._exit(9)

    sdfnet.data.store.xdmf = die  # type: ignore[assignment]  # the trajectory's arrays are written by then
    prepare(SMALL, Path(folder))


def test_a_killed_run_blocks_nothing_and_its_leftover_is_cleaned() -> None:
    process = get_context("spawn").Process(target=_killed_while_writing, args=(str(FOLDER.resolve()),))
    process.start()
    process.join()
    assert process.exitcode == 9
    left = [path for path in FOLDER.glob(".*-trajectory-*") if not path.name.endswith(".lock")]
    assert len(left) == 1
    assert not list(FOLDER.glob("trajectory-*"))
    assert prepare(SMALL, FOLDER).built == STAGES[1:]
    assert not left[0].exists()


@dataclass(frozen=True)
class SlowSphere(Sphere):
    """Writes a line each time that it is made, and takes long enough for a second run to come."""

    def tet_mesh(self) -> TetMesh:
        with Path(os.environ["SDFNET_TEST_LINES"]).open("a") as lines:
            lines.write("made\n")
        threading.Event().wait(0.3)
        return super().tet_mesh()


def test_two_runs_at_once_build_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDFNET_TEST_LINES", "lines.txt")
    slow = replace(SMALL, scene=replace(SMALL.scene, geometry=SlowSphere(radius=0.05, cells=3)))
    results: list[PreparedFiles] = []
    runs = [threading.Thread(target=lambda: results.append(prepare(slow, FOLDER))) for _ in range(3)]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert Path("lines.txt").read_text() == "made\n"
    assert sorted(stage for result in results for stage in result.built) == sorted(STAGES)
    assert len({result.distances for result in results}) == 1


def _prepare_and_tell(folder: str, told: str) -> None:
    built = prepare(SMALL, Path(folder)).built
    Path(told).write_text(",".join(built))


def test_two_processes_at_once_build_once() -> None:
    context = get_context("spawn")
    told = [Path(f"told-{k}.txt").resolve() for k in range(2)]
    processes = [context.Process(target=_prepare_and_tell, args=(str(FOLDER.resolve()), str(path))) for path in told]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0]
    assert sorted(stage for path in told for stage in path.read_text().split(",") if stage) == sorted(STAGES)


def _crumpled() -> Trajectory:
    """A ball whose one side is pushed out through the other in its last frame."""
    trajectory = simulate(SMALL.scene, SMALL.scene.geometry.tet_mesh())  # type: ignore[attr-defined]
    displacements = trajectory.displacements.copy()
    displacements[-1] = np.where(trajectory.mesh.nodes[:, :1] < -0.02, [0.15, 0.0, 0.0], 0.0)
    return replace(trajectory, displacements=displacements)


def test_a_broken_frame_is_refused_where_that_is_asked_for() -> None:
    with pytest.raises(GeometryError, match="every frame must be whole, found that 1 of 3 frames are broken.*or accept them with sampling.broken_frames=keep"):
        sample_distances(_crumpled(), replace(SMALL.sampling, broken_frames="refuse"))


def test_signs_that_contradict_the_winding_number_are_an_error_when_they_are_many() -> None:
    whole = simulate(SMALL.scene, SMALL.scene.geometry.tet_mesh())  # type: ignore[attr-defined]
    mirrored = replace(whole, displacements=np.where(np.arange(3)[:, None, None] == 2, -2 * whole.mesh.nodes, 0.0))
    with pytest.raises(GeometryError, match="signs of distances in the .* points contradict the winding number, most in frame 2; at most 1 % may"):
        sample_distances(mirrored, SMALL.sampling)


def test_whole_frames_are_marked_as_such_in_the_file() -> None:
    checks = read_trajectory(prepare(SMALL, FOLDER).trajectory).checks
    assert checks is not None
    assert checks.inverted_tets.tolist() == checks.crossing_faces.tolist() == [0, 0, 0]


def test_load_cases_are_one_family_of_shapes() -> None:
    scene = replace(SMALL.scene, effects={}, load_cases={"left": POKE, "right": replace(POKE, center=(0.05, 0.0, 0.0))})
    files = prepare(replace(SMALL, scene=scene), FOLDER)
    trajectory, samples = read_trajectory(files.trajectory), read_distances(files.distances)
    assert trajectory.cases == ("left", "right")
    assert len(samples.distances) == scene.frame_count == 6
    alone = simulate(replace(scene, effects={"right": scene.load_cases["right"]}, load_cases={}), trajectory.mesh)
    np.testing.assert_allclose(trajectory.case("right").displacements, alone.displacements, rtol=1e-12, atol=1e-18)
