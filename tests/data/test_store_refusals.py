"""Files that are missing, truncated, foreign, of another version or not whole are refused by name, with the cure."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest

from sdfnet.data import store
from sdfnet.errors import StoreError
from tests.data.stored_examples import MESH, PROVENANCE, READERS, SAMPLES, TRAJECTORY, small_mesh, write_all

reads_every_file = pytest.mark.parametrize(("path", "read"), READERS, ids=["trajectory", "distances", "mesh"])


@reads_every_file
def test_a_missing_file_is_named(path: Path, read: Callable[[Path], Any]) -> None:
    with pytest.raises(StoreError, match=rf"'{path}'"):
        read(path)


@reads_every_file
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused_by_name_with_the_cure(path: Path, read: Callable[[Path], Any], share: float) -> None:
    write_all()
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
    store.write_mesh(MESH, small_mesh(), PROVENANCE)
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
    write_all()
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
    ball = small_mesh().surface()
    meshio.Mesh(ball.vertices, [("triangle", ball.faces)]).write(MESH)
    with pytest.raises(StoreError, match="'mesh.vtu' is not a whole tet mesh .*tetra"):
        store.read_mesh(MESH)
    with pytest.raises(StoreError, match="'mesh.json' is missing or not whole .*delete 'mesh.vtu' and both are made again"):
        store.read_mesh_provenance(MESH)
    Path("mesh.json").write_text('{"seconds": 1')
    with pytest.raises(StoreError, match="'mesh.json' is missing or not whole"):
        store.read_mesh_provenance(MESH)


def test_contents_that_are_no_mesh_or_no_json_are_refused_like_a_truncated_file() -> None:
    write_all()
    with h5py.File(TRAJECTORY, "a") as file:
        file.attrs["report"] = '{"steps": 7'
    with pytest.raises(StoreError, match=r"'trajectory\.h5' is truncated or not an HDF5 file of sdfnet .*delimiter.*; delete it and it is made again"):
        store.read_trajectory(TRAJECTORY)
    write_all()
    with h5py.File(TRAJECTORY, "a") as file:
        file["nodes"][3, 1] = np.nan
    with pytest.raises(StoreError, match=r"'trajectory\.h5' is truncated or not .*must be finite, found 1.*; delete it and it is made again"):
        store.read_trajectory(TRAJECTORY)
