"""Files that others can open and that say what they were made from.

A trajectory or a set of distances is one HDF5 file with units, a format version and its provenance (settings, package
versions, seconds) as attributes. Files are written beside their place and moved there whole, so a reader never sees half of one.
"""

import errno
import inspect
import json
import math
import os
import shutil
import sys
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
from jaxtyping import Float32, Float64, Int32

from sdfnet.data.patient_file import PatientFile
from sdfnet.data.sampling import SamplingBox
from sdfnet.data.versions import versions
from sdfnet.data.xdmf import show_frame, xdmf
from sdfnet.declared import as_found
from sdfnet.errors import ConfigurationError, GeometryError, StoreError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.trajectory import FrameChecks, Trajectory

FORMAT_VERSION = 2  # raised when the meaning of a file changes; part of every name


@dataclass(frozen=True, eq=False)
class DistanceSamples:
    """Signed distances (m) of all frames at shared points, and which points the paper's filter keeps in each frame."""

    box: SamplingBox
    points: Float32[np.ndarray, "points 3"]  # m
    distances: Float32[np.ndarray, "frames points"]
    kept: Int32[np.ndarray, "frames kept"]
    near_points: Float32[np.ndarray, "near 3"]  # m
    near_distances: Float32[np.ndarray, "frames near"]


def described(settings: Any) -> Any:
    """Settings as plain JSON values, the class of every dataclass included, for hashing and provenance.

    A class from elsewhere (an effect of a plugin) is described by the code of its module too, so that what was made with other code is not taken for its own.
    """
    if is_dataclass(settings) and not isinstance(settings, type):
        kind = type(settings)
        return {"kind": kind.__name__} | _foreign_code(kind) | {entry.name: described(getattr(settings, entry.name)) for entry in fields(settings)}
    if isinstance(settings, Mapping):
        return {str(key): described(value) for key, value in settings.items()}
    if isinstance(settings, list | tuple):
        return [described(value) for value in settings]
    return str(settings) if isinstance(settings, float) and not math.isfinite(settings) else settings  # JSON has no infinity


def key_of(*parts: Any) -> str:
    """The short hash that names what is made from these settings and hashes."""
    text = json.dumps([FORMAT_VERSION, *(described(part) for part in parts)], sort_keys=True, default=_no_setting)
    return sha256(text.encode()).hexdigest()[:12]


def _no_setting(value: Any) -> None:
    raise ConfigurationError(
        f"files are named by settings, which are numbers, texts, tuples and dataclasses, found {as_found(value, type(value))}; "
        "derive an effect or region of your own whose fields are numbers, or stay in memory with sdfnet.physics.simulate.simulate"
    )


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a path to write to; on success it becomes `path` in one move, on failure nothing is left."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        yield unfinished
        unfinished.replace(path)
    except OSError as error:
        raise StoreError(f"'{path}' could not be written: {error}; free some space or choose another folder") from error
    finally:
        unfinished.unlink(missing_ok=True)


def write_json(path: Path, contents: Mapping[str, Any]) -> None:
    """Write JSON in one move; what is not finite becomes null. Raises StoreError when it cannot be written."""
    with written_whole(path) as unfinished:
        unfinished.write_text(json.dumps(finite(contents), indent=2, allow_nan=False))


def finite(value: Any) -> Any:
    """A value for JSON, which has no infinity: null for each number, however deep, that is not finite."""
    if isinstance(value, Mapping):
        return {name: finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def remove_unfinished(path: Path) -> None:
    """Delete what a killed run left of `path` and of the files beside it. Only for who holds its lock, or a run at work loses its file."""
    for unfinished in path.parent.glob(f".*-{path.stem}.*"):
        unfinished.unlink()


def write_mesh(path: Path, mesh: TetMesh, provenance: Mapping[str, Any]) -> None:
    """Write the tet mesh as .vtu (exact, what sdfnet reads again), beside it as Medit .mesh, and its provenance as .json."""
    contents = meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)])
    with written_whole(path) as exact, written_whole(path.with_suffix(".mesh")) as medit, written_whole(path.with_suffix(".json")) as record:
        record.write_text(json.dumps({**provenance, "versions": versions()}, indent=2))
        contents.write(medit)
        contents.write(exact)


def read_mesh(path: Path) -> TetMesh:
    """Read a .vtu or .mesh of tets. Raises StoreError when it is not one."""
    read = meshio.medit.read if path.suffix == ".mesh" else meshio.vtu.read  # meshio.read ends the program where these raise
    try:
        contents = read(path)
        return TetMesh(np.asarray(contents.points, dtype=np.float64), np.asarray(contents.cells_dict["tetra"], dtype=np.int64))
    except (meshio.ReadError, zlib.error, AssertionError, LookupError, ValueError, OSError, GeometryError) as error:
        raise StoreError(f"'{path}' is not a whole tet mesh ({error}); delete it and it is made again") from error


def read_mesh_provenance(path: Path) -> dict[str, Any]:
    """The settings, versions and seconds of a tet mesh. Raises StoreError."""
    try:
        return dict(json.loads(path.with_suffix(".json").read_text()))
    except (OSError, ValueError) as error:
        raise StoreError(f"'{path.with_suffix('.json')}' is missing or not whole ({error}); delete '{path}' and both are made again") from error


def write_trajectory(path: Path, trajectory: Trajectory, provenance: Mapping[str, Any]) -> None:
    """Write a trajectory as HDF5 with an .xdmf beside it that ParaView opens as an animation."""
    size = trajectory.displacements.nbytes + trajectory.mesh.nodes.nbytes + trajectory.mesh.tets.nbytes
    # The .xdmf takes its place last: without its arrays it would be worth nothing.
    with written_whole(path.with_suffix(".xdmf")) as unfinished, new_file(path, "trajectory", provenance, size) as file:
        _put(file, "nodes", trajectory.mesh.nodes, "m")
        _put(file, "tets", trajectory.mesh.tets, "node index")
        _put(file, "times", trajectory.times, "s")
        _put(file, "displacements", trajectory.displacements, "m")
        for frame in range(len(trajectory.times)):
            show_frame(file, frame)
        file.attrs["time_step_s"] = trajectory.time_step
        file.attrs["report"], file.attrs["cases"] = json.dumps(trajectory.report), json.dumps(trajectory.cases)
        if trajectory.checks is not None:
            _put(file, "inverted_tets", trajectory.checks.inverted_tets, "tets per frame")
            _put(file, "crossing_faces", trajectory.checks.crossing_faces, "pairs of faces per frame")
        xdmf(path.name, trajectory).write(unfinished, xml_declaration=True, encoding="utf-8")


def read_trajectory(path: Path) -> Trajectory:
    """Read what `write_trajectory` wrote. Raises StoreError."""
    with known_file(path, "trajectory") as file:
        mesh, report, cases = TetMesh(file["nodes"][:], file["tets"][:]), json.loads(file.attrs["report"]), tuple(json.loads(file.attrs["cases"]))
        checks = FrameChecks(file["inverted_tets"][:], file["crossing_faces"][:]) if "inverted_tets" in file else None
        return Trajectory(mesh, file["times"][:], file["displacements"][:], float(file.attrs["time_step_s"]), report, cases, checks)


def write_distances(path: Path, samples: DistanceSamples, provenance: Mapping[str, Any]) -> None:
    """Write a set of distances as HDF5."""
    size = samples.distances.nbytes + samples.near_distances.nbytes + samples.points.nbytes + samples.near_points.nbytes + samples.kept.nbytes
    with new_file(path, "distances", provenance, size) as file:
        _put(file, "box", np.stack([samples.box.lower, samples.box.upper]), "m")
        _put(file, "points", samples.points, "m")
        _put(file, "distances", samples.distances, "m, negative inside")
        _put(file, "kept", samples.kept, "point index")
        _put(file, "near_points", samples.near_points, "m")
        _put(file, "near_distances", samples.near_distances, "m, negative inside")


def read_distances(path: Path) -> DistanceSamples:
    """Read what `write_distances` wrote. Raises StoreError."""
    with known_file(path, "distances") as file:
        return DistanceSamples(
            SamplingBox(*file["box"][:]), file["points"][:], file["distances"][:], file["kept"][:], file["near_points"][:], file["near_distances"][:]
        )


def read_provenance(path: Path) -> dict[str, Any]:
    """The settings, versions and seconds recorded in one of sdfnet's HDF5 files. Raises StoreError."""
    with known_file(path, None) as file:
        return dict(json.loads(file.attrs["provenance"]))


@contextmanager
def new_file(path: Path, kind: str, provenance: Mapping[str, Any], size: int) -> Iterator[h5py.File]:
    """An HDF5 file of sdfnet to write `size` bytes to, moved to `path` when whole. Raises StoreError."""
    with written_whole(path) as unfinished:
        free = shutil.disk_usage(path.parent).free
        if free < size:  # asked before, so that nobody waits for what cannot be
            raise OSError(errno.ENOSPC, f"{size / 1e6:.3g} MB are needed, {free / 1e6:.3g} MB are free")
        with PatientFile(unfinished, "w+") as disk:
            try:
                with h5py.File(disk, "w") as file:
                    yield _labelled(file, kind, provenance)
            except RuntimeError as error:  # h5py's when HDF5 cannot flush or close
                raise disk.error or OSError(errno.EIO, str(error)) from error
            if disk.error is not None:
                raise disk.error


def _labelled(file: h5py.File, kind: str, provenance: Mapping[str, Any]) -> h5py.File:
    file.attrs.update({"format": "sdfnet", "kind": kind, "version": FORMAT_VERSION, "provenance": json.dumps({**provenance, "versions": versions()})})
    return file


@contextmanager
def known_file(path: Path, kind: str | None) -> Iterator[h5py.File]:
    """An HDF5 file of sdfnet to read, of that kind unless None. Raises StoreError when it is not one."""
    cure = "delete it and it is made again"
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != "sdfnet":
                raise StoreError(f"'{path}' is an HDF5 file of another program, expected one written by sdfnet; {cure}")
            if file.attrs["version"] != FORMAT_VERSION:
                raise StoreError(f"'{path}' has format version {file.attrs['version']}, expected {FORMAT_VERSION}; {cure}")
            if kind is not None and file.attrs["kind"] != kind:
                raise StoreError(f"'{path}' holds {file.attrs['kind']}, expected {kind}; {cure}")
            yield file
    except FileNotFoundError as error:
        raise StoreError(f"no file at '{path}'; run prepare.py first") from error
    except (OSError, KeyError, RuntimeError, ValueError, GeometryError) as error:  # what h5py, json and a mesh say of contents that are not whole
        raise StoreError(f"'{path}' is truncated or not an HDF5 file of sdfnet ({error}); {cure}") from error


def _foreign_code(kind: type) -> dict[str, str]:
    if kind.__module__.startswith("sdfnet."):
        return {}
    try:
        return {"code": sha256(inspect.getsource(sys.modules[kind.__module__]).encode()).hexdigest()[:12]}
    except (KeyError, OSError, TypeError):  # typed at a prompt
        return {}


def _put(file: h5py.File, name: str, values: Float64[np.ndarray, "..."] | np.ndarray, unit: str) -> None:
    file.create_dataset(name, data=values).attrs["unit"] = unit
