"""Files come back to the bit, say what they are, and are refused by name when they are not whole."""

import json
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
import pytest
import pyvista

from sdfnet.data import store
from sdfnet.data.sampling import SamplingBox
from sdfnet.data.store import DistanceSamples
from sdfnet.errors import StoreError
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Effect, Material, Sampling

PROVENANCE = {"scene": {"kind": "Scene"}, "seconds": 1.5}
TRAJECTORY, SAMPLES, MESH = Path("trajectory.h5"), Path("distances.h5"), Path("mesh.vtu")


def _mesh() -> TetMesh:
    return Sphere(radius=0.05, cells=3).tet_mesh()


def _trajectory() -> Trajectory:
    mesh = _mesh()
    displacements = np.random.default_rng(0).normal(0, 1e-3, (4, len(mesh.nodes), 3))
    return Trajectory(mesh, np.array([0.0, 0.1, 0.2, 1 / 3]), displacements, 1e-6 / 3, {"steps": 7, "energy_drift": 1e-13, "mass": "lumped"})


def _samples() -> DistanceSamples:
    generator = np.random.default_rng(1)

    def random(*shape: int) -> np.ndarray:
        return generator.normal(size=shape).astype(np.float32)

    box = SamplingBox(np.array([0.1, 0.2, 0.3]), np.array([1.1, 1.2, 1.3]))
    kept = np.sort(generator.integers(0, 50, (4, 20)).astype(np.int32), axis=1)
    return DistanceSamples(box, random(50, 3), random(4, 50), kept, random(10, 3), random(4, 10))


def _write_all() -> None:
    store.write_trajectory(TRAJECTORY, _trajectory(), PROVENANCE)
    store.write_distances(SAMPLES, _samples(), PROVENANCE)
    store.write_mesh(MESH, _mesh(), PROVENANCE)


READERS: list[tuple[Path, Callable[[Path], Any]]] = [
    (TRAJECTORY, store.read_trajectory),
    (SAMPLES, store.read_distances),
    (MESH, store.read_mesh),
]
reads_every_file = pytest.mark.parametrize(("path", "read"), READERS, ids=["trajectory", "distances", "mesh"])


def test_a_trajectory_comes_back_to_the_bit() -> None:
    written = _trajectory()
    store.write_trajectory(TRAJECTORY, written, PROVENANCE)
    read = store.read_trajectory(TRAJECTORY)
    for name in ("times", "displacements"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), strict=True)
    assert read.mesh.digest == written.mesh.digest
    assert read.time_step == written.time_step
    assert read.report == written.report


def test_distances_come_back_to_the_bit() -> None:
    written = _samples()
    store.write_distances(SAMPLES, written, PROVENANCE)
    read = store.read_distances(SAMPLES)
    for name in ("points", "distances", "kept", "near_points", "near_distances"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), strict=True)
    np.testing.assert_array_equal(read.box.lower, written.box.lower)
    np.testing.assert_array_equal(read.box.upper, written.box.upper)


def test_a_mesh_comes_back_to_the_bit_and_its_medit_copy_to_rounding() -> None:
    store.write_mesh(MESH, _mesh(), PROVENANCE)
    assert store.read_mesh(MESH).digest == _mesh().digest
    medit = store.read_mesh(MESH.with_suffix(".mesh"))
    np.testing.assert_allclose(medit.nodes, _mesh().nodes, atol=1e-15)  # printed with 16 digits
    np.testing.assert_array_equal(medit.tets, _mesh().tets)


def test_every_array_says_its_unit_and_every_file_its_version_and_provenance() -> None:
    _write_all()
    units = {"nodes": "m", "tets": "node index", "times": "s", "displacements": "m", "box": "m", "points": "m", "near_points": "m"}
    units |= {"distances": "m, negative inside", "near_distances": "m, negative inside", "kept": "point index"}
    for path, kind in ((TRAJECTORY, "trajectory"), (SAMPLES, "distances")):
        with h5py.File(path) as file:
            assert file.attrs["format"] == "sdfnet"
            assert file.attrs["kind"] == kind
            assert file.attrs["version"] == store.FORMAT_VERSION
            assert len(file) > 3
            for name, values in file.items():
                assert values.attrs["unit"] == units[name]
    for provenance in (store.read_provenance(TRAJECTORY), store.read_provenance(SAMPLES), store.read_mesh_provenance(MESH)):
        assert provenance == {**PROVENANCE, "versions": store.versions()}
    assert set(store.versions()) == set(store.RECORDED_PACKAGES)


@reads_every_file
def test_a_missing_file_is_named(path: Path, read: Callable[[Path], Any]) -> None:
    with pytest.raises(StoreError, match=rf"'{path}'"):
        read(path)


@reads_every_file
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused_by_name_with_the_cure(path: Path, read: Callable[[Path], Any], share: float) -> None:
    _write_all()
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(StoreError, match=rf"'{path}' is (truncated|not a whole tet mesh).*delete it and it is made again"):
        read(path)


@reads_every_file
def test_a_file_of_another_kind_of_content_is_refused(path: Path, read: Callable[[Path], Any]) -> None:
    path.write_bytes(b"a letter to a friend\n" * 100)
    with pytest.raises(StoreError, match=rf"'{path}' is (truncated or not an HDF5 file|not a whole tet mesh)"):
        read(path)


def test_a_mesh_file_with_a_flipped_bit_never_ends_the_program() -> None:
    store.write_mesh(MESH, _mesh(), PROVENANCE)
    content, generator = MESH.read_bytes(), np.random.default_rng(0)
    refused = 0
    for place in generator.integers(0, len(content), 100):
        MESH.write_bytes(content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :])
        try:
            store.read_mesh(MESH)
        except StoreError:
            refused += 1
    assert refused > 50  # the rest fell on comments, names and spaces


def test_an_hdf5_file_of_another_program_is_refused() -> None:
    with h5py.File(TRAJECTORY, "w") as file:
        file["nodes"] = np.zeros((4, 3))
    with pytest.raises(StoreError, match="'trajectory.h5' is an HDF5 file of another program, expected one written by sdfnet; delete it"):
        store.read_trajectory(TRAJECTORY)


def test_a_file_of_another_version_or_kind_or_without_an_array_says_which() -> None:
    _write_all()
    with pytest.raises(StoreError, match="'trajectory.h5' holds trajectory, expected distances"):
        store.read_distances(TRAJECTORY)
    with h5py.File(SAMPLES, "a") as file:
        del file["kept"]
    with pytest.raises(StoreError, match="'distances.h5' is truncated .*kept"):
        store.read_distances(SAMPLES)
    with h5py.File(TRAJECTORY, "a") as file:
        file.attrs["version"] = store.FORMAT_VERSION + 1
    with pytest.raises(StoreError, match=f"has format version {store.FORMAT_VERSION + 1}, expected {store.FORMAT_VERSION}; delete it"):
        store.read_trajectory(TRAJECTORY)


def test_a_mesh_of_triangles_or_without_its_provenance_is_refused() -> None:
    ball = _mesh().surface()
    meshio.Mesh(ball.vertices, [("triangle", ball.faces)]).write(MESH)
    with pytest.raises(StoreError, match="'mesh.vtu' is not a whole tet mesh .*tetra"):
        store.read_mesh(MESH)
    with pytest.raises(StoreError, match="'mesh.json' is missing or not whole .*delete 'mesh.vtu' and both are made again"):
        store.read_mesh_provenance(MESH)
    Path("mesh.json").write_text('{"seconds": 1')
    with pytest.raises(StoreError, match="'mesh.json' is missing or not whole"):
        store.read_mesh_provenance(MESH)


def _fail_half_way(path: Path) -> None:
    with store.written_whole(path) as unfinished:
        unfinished.write_text("half")
        raise RuntimeError("stop")


def test_what_fails_while_it_is_written_leaves_nothing_and_spares_what_was_there() -> None:
    path = Path("deep/er/result.txt")
    with pytest.raises(RuntimeError, match="stop"):
        _fail_half_way(path)
    assert list(path.parent.iterdir()) == []
    with store.written_whole(path) as unfinished:
        unfinished.write_text("whole")
        assert not path.exists()
    with pytest.raises(RuntimeError, match="stop"):
        _fail_half_way(path)
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]


@contextmanager
def _full_disk() -> Iterator[None]:
    """No file may grow beyond 2 kB: the write fails as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_fills_up_is_a_clear_error_and_leaves_nothing() -> None:
    mesh = _mesh()
    with _full_disk(), pytest.raises(StoreError, match=r"'data/mesh\.\w+' could not be written: .*File too large.*; free some space or choose another folder"):
        store.write_mesh(Path("data/mesh.vtu"), mesh, PROVENANCE)
    assert list(Path("data").iterdir()) == []


@pytest.mark.parametrize(
    "write",
    [lambda path: store.write_trajectory(path, _trajectory(), PROVENANCE), lambda path: store.write_distances(path, _samples(), PROVENANCE)],
    ids=["trajectory", "distances"],
)
def test_a_disk_too_small_is_said_with_both_sizes_before_anything_is_written(write: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(StoreError, match=r"'data/file\.h5' could not be written: .* MB are needed, 0\.001 MB are free; free some space or choose"):
        write(Path("data/file.h5"))
    assert list(Path("data").iterdir()) == []


def test_leftovers_of_a_killed_run_are_deleted_and_nothing_else() -> None:
    leftovers = [Path(name) for name in (".99-mesh-abc.vtu", ".99-mesh-abc.json", ".7-mesh-abc.mesh")]
    others = [Path(name) for name in ("mesh-abc.json", ".mesh-abc.vtu.lock", ".99-mesh-xyz.vtu", ".99-trajectory-abc.h5")]
    for path in leftovers + others:
        path.touch()
    store.remove_unfinished(Path("mesh-abc.vtu"))
    assert sorted(Path().iterdir()) == sorted(others)


def test_the_xdmf_shows_every_frame_to_a_reader_that_knows_nothing_of_sdfnet() -> None:
    trajectory = _trajectory()
    store.write_trajectory(TRAJECTORY, trajectory, PROVENANCE)
    root = ElementTree.parse("trajectory.xdmf").getroot()
    grids = root.findall("./Domain/Grid/Grid")
    assert len(grids) == 4

    def values(item: ElementTree.Element) -> np.ndarray:
        if item.get("ItemType") == "HyperSlab":
            selection, source = item.findall("DataItem")
            start, stride, count = np.array(str(selection.text).split(), dtype=int).reshape([int(n) for n in str(selection.get("Dimensions")).split()])
            whole = values(source)
            part = whole[tuple(slice(s, s + k * c, k) for s, k, c in zip(start, stride, count, strict=True))]
            return part.reshape([int(n) for n in str(item.get("Dimensions")).split()])
        name, place = str(item.text).strip().split(":")
        with h5py.File(name) as file:
            stored = file[place]
            assert [int(n) for n in str(item.get("Dimensions")).split()] == list(stored.shape)
            assert stored.dtype.itemsize == int(str(item.get("Precision")))
            assert stored.dtype.kind == {"Float": "f", "Int": "i"}[str(item.get("NumberType"))]
            return np.asarray(stored)

    for frame, grid in enumerate(grids):
        time, topology, geometry, attribute = (grid.find(name) for name in ("Time", "Topology", "Geometry", "Attribute"))
        assert time is not None
        assert float(str(time.get("Value"))) == pytest.approx(trajectory.times[frame], rel=1e-8)
        for element, expected in ((topology, trajectory.mesh.tets), (geometry, trajectory.mesh.nodes), (attribute, trajectory.displacements[frame])):
            assert element is not None
            np.testing.assert_array_equal(values(element[0]), expected)


def test_paraviews_own_reader_finds_the_displaced_tets() -> None:
    trajectory = _trajectory()
    store.write_trajectory(TRAJECTORY, trajectory, PROVENANCE)
    reader = pyvista.get_reader("trajectory.xdmf")
    assert isinstance(reader, pyvista.XdmfReader)
    np.testing.assert_allclose(reader.time_values, trajectory.times, rtol=1e-8)
    reader.set_active_time_value(reader.time_values[2])
    grid: Any = reader.read()
    while isinstance(grid, pyvista.MultiBlock):
        grid = grid[0]
    assert grid.n_cells == len(trajectory.mesh.tets)
    np.testing.assert_array_equal(grid.point_data["displacement"], trajectory.displacements[2])


@dataclass(frozen=True)
class Tickle(Effect):
    """An effect from outside sdfnet."""

    strength: float = 1.0


def test_a_key_follows_settings_and_their_kind_and_nothing_else() -> None:
    key = store.key_of(Sampling(), "abc")
    assert key == store.key_of(Sampling(), "abc")
    assert len({key, store.key_of(Sampling(seed=1), "abc"), store.key_of(Sampling(), "abd"), store.key_of("abc", Sampling())}) == 4
    assert store.key_of({"a": Pinned(), "b": Material()}) == store.key_of({"b": Material(), "a": Pinned()})


def test_settings_are_described_as_plain_json_with_their_kind() -> None:
    assert store.described(Sphere(radius=0.1, cells=4)) == {"kind": "Sphere", "radius": 0.1, "cells": 4}
    assert json.loads(json.dumps(store.described({"foot": Pinned()})))["foot"]["normal"] == [0.0, 0.0, 1.0]


def test_the_key_of_an_effect_from_outside_follows_its_code(monkeypatch: pytest.MonkeyPatch) -> None:
    before = store.key_of(Tickle())
    assert store.described(Tickle())["strength"] == 1.0
    monkeypatch.setattr("inspect.getsource", lambda kind: f"class {kind.__name__}: another")
    assert store.key_of(Tickle()) != before
