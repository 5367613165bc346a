"""Triangle surfaces: what they are and how they are read."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from sdfnet.checked import Checked
from sdfnet.errors import GeometryError

FORMATS = ".obj, .ply, .stl, .off or .usd"
NEARNESS = 1e-9  # of the diagonal: nearer points are one, lower triangles have no area; a hundred times finer than float32 coordinates


@dataclass(frozen=True, eq=False)
class Surface(Checked):
    """A triangle surface; normals point outward by the right-hand rule."""

    vertices: Float64[np.ndarray, "vertices 3"]  # m
    faces: Int64[np.ndarray, "faces 3"]

    @cached_property
    def diagonal(self) -> float:
        """Length of the bounding box diagonal, m."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def as_trimesh(self) -> trimesh.Trimesh:
        """The same surface for trimesh, vertices neither merged nor reordered."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def load_surface(path: Path) -> Surface:
    """Read a triangle surface from .obj, .ply, .stl, .off or .usd/.usda/.usdc.

    Vertices that are equal to the bit are merged, because .stl has no shared ones; those that no face uses are left
    out. Raises GeometryError when the file is missing, unreadable, empty or not finite.
    """
    if not path.is_file():
        raise GeometryError(f"no surface file at '{path}'; give an existing {FORMATS}")
    vertices, faces = _read_usd(path) if path.suffix.lower().startswith(".usd") else _read_trimesh(path)
    if len(faces) == 0:
        raise GeometryError(f"'{path}' holds no triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise GeometryError(f"'{path}' could not be read: a face names vertex {faces.max()} of {len(vertices)}; export it again")
    if not np.isfinite(vertices).all():
        raise GeometryError(f"'{path}' has {int((~np.isfinite(vertices)).any(axis=1).sum())} vertices that are not finite")
    used, numbered = np.unique(faces, return_inverse=True)
    _, first, merged = np.unique(vertices[used] + 0.0, axis=0, return_index=True, return_inverse=True)  # + 0.0 makes -0.0 equal to it
    in_order = np.argsort(np.argsort(first))[merged.ravel()]  # vertices keep the order of the file
    return Surface(vertices[used][np.sort(first)], in_order[numbered].reshape(-1, 3))


def near_points(points: Float64[np.ndarray, "points 3"]) -> Int64[np.ndarray, " near"]:
    """Indices of the points nearer than 1e-9 of their bounding box diagonal to another."""
    return np.flatnonzero(cKDTree(points).query(points, k=2)[0][:, 1] <= NEARNESS * np.linalg.norm(np.ptp(points, axis=0)))


def place_text(place: Iterable[float]) -> str:
    """A place as messages write it, four digits: (0.01, -0.025, 0.1312)."""
    return f"({', '.join(f'{coordinate:.4g}' for coordinate in place)})"


def _read_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except (ValueError, IndexError, KeyError, NotImplementedError, UnicodeDecodeError) as error:
        raise GeometryError(
            f"'{path}' could not be read: it must be a whole {FORMATS}, found {path.stat().st_size} bytes that end early or are something else: {error}; "
            "export it again, or give it the ending of its kind"
        ) from error
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _read_usd(path: Path) -> tuple[np.ndarray, np.ndarray]:
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise GeometryError(f"'{path}' could not be read as USD; export it again") from error
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    if len(meshes) != 1:
        raise GeometryError(f"'{path}' must hold exactly one mesh, found {len(meshes)}")
    points, counts, indices = meshes[0].GetPointsAttr().Get(), meshes[0].GetFaceVertexCountsAttr().Get(), meshes[0].GetFaceVertexIndicesAttr().Get()
    if not (points and counts and indices):
        raise GeometryError(f"'{path}' holds no triangles")
    if set(counts) != {3}:
        raise GeometryError(f"'{path}' must hold triangles, found faces of {sorted(set(counts))} corners; triangulate it first")
    to_world = np.asarray(UsdGeom.XformCache().GetLocalToWorldTransform(meshes[0].GetPrim()))  # acts on row vectors
    vertices = np.asarray(points, dtype=np.float64) @ to_world[:3, :3] + to_world[3, :3]
    return vertices, np.asarray(indices, dtype=np.int64).reshape(-1, 3)
