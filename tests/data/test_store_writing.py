"""A file is written whole or not at all: failures half way, full disks, two writers, killed writers."""

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import h5py
import pytest

from sdfnet.data import store
from sdfnet.errors import StoreError
from tests.data.stored_examples import PROVENANCE, small_mesh, small_samples, small_trajectory

writes_hdf5 = pytest.mark.parametrize(
    "write",
    [lambda path: store.write_trajectory(path, small_trajectory(), PROVENANCE), lambda path: store.write_distances(path, small_samples(), PROVENANCE)],
    ids=["trajectory", "distances"],
)


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
def _full_disk(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes: the write fails as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_fills_up_is_a_clear_error_and_leaves_nothing() -> None:
    mesh = small_mesh()
    with (
        _full_disk(2048),
        pytest.raises(StoreError, match=r"'data/mesh\.\w+' could not be written: .*File too large.*; free some space or choose another folder"),
    ):
        store.write_mesh(Path("data/mesh.vtu"), mesh, PROVENANCE)
    assert list(Path("data").iterdir()) == []


@writes_hdf5
@pytest.mark.parametrize("missing", [1, 100, 1000, 0.5, 0.999])
def test_hdf5_on_a_disk_that_fills_up_at_any_byte_is_a_clear_error_and_leaves_nothing(write: Callable[[Path], None], missing: float) -> None:
    write(Path("whole.h5"))
    whole = Path("whole.h5").stat().st_size
    limit = whole - missing if missing >= 1 else (1 - missing) * whole  # the last bytes are written when HDF5 closes the file
    with _full_disk(int(limit)), pytest.raises(StoreError, match=r"'data/file\.h5' could not be written: .*File too large; free some space or choose another"):
        write(Path("data/file.h5"))
    assert list(Path("data").iterdir()) == []
    with _full_disk(whole):
        write(Path("data/file.h5"))
    assert Path("data/file.h5").stat().st_size == whole


@writes_hdf5
def test_what_hdf5_itself_cannot_do_is_an_error_of_the_file(write: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch) -> None:
    close = h5py.File.__exit__

    def close_badly(self: h5py.File, *error: object) -> None:
        close(self, *error)
        raise RuntimeError("Can't decrement id ref count (unable to extend file properly)")

    monkeypatch.setattr(h5py.File, "__exit__", close_badly)
    with pytest.raises(StoreError, match=r"'data/file\.h5' could not be written: .*unable to extend file properly.*; free some space"):
        write(Path("data/file.h5"))
    assert list(Path("data").iterdir()) == []


@writes_hdf5
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


def test_two_writers_of_one_file_leave_it_whole_and_the_last_one_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path("result.txt")
    with store.written_whole(path) as first, first.open("w") as slow:
        slow.write("first, ")
        with monkeypatch.context() as patch:
            patch.setattr("os.getpid", lambda: -1)  # as another process
            with store.written_whole(path) as second:
                second.write_text("second, whole")
        slow.write("whole")
        slow.flush()
        assert path.read_text() == "second, whole"
    assert path.read_text() == "first, whole"
    assert list(Path().iterdir()) == [path]
