"""Triangle surfaces: load, inspect, refuse what is not closed."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64, Int64

from sdfnet.errors import GeometryError


@dataclass(frozen=True, eq=False)
class Surface:
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

    Coincident vertices are merged, because .stl has no shared ones. Raises GeometryError when the file is missing,
    unreadable, empty or not finite.
    """
    if not path.is_file():
        raise GeometryError(f"no surface file at '{path}'; give an existing .obj, .ply, .stl or .usd")
    vertices, faces = _read_usd(path) if path.suffix.lower().startswith(".usd") else _read_trimesh(path)
    if len(faces) == 0:
        raise GeometryError(f"'{path}' holds no triangles")
    if not np.isfinite(vertices).all():
        raise GeometryError(f"'{path}' has {int((~np.isfinite(vertices)).any(axis=1).sum())} vertices that are not finite")
    merged = trimesh.Trimesh(vertices, faces, process=True)
    return Surface(np.asarray(merged.vertices, dtype=np.float64), np.asarray(merged.faces, dtype=np.int64))


def require_closed(surface: Surface, origin: str) -> None:
    """Raise GeometryError unless the surface bounds a volume: every edge shared by two faces, winding outward."""
    mesh = surface.as_trimesh()
    uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    n_open, n_crowded = int((uses == 1).sum()), int((uses > 2).sum())
    if n_open or n_crowded:
        raise GeometryError(
            f"{origin} must be a closed surface, found {n_open} open edges and {n_crowded} edges shared by more than two faces; "
            "close the holes in a mesh editor, or set dataset.scene.geometry.repair=true to let fTetWild fill them"
        )
    if not mesh.is_winding_consistent or mesh.volume <= 0:
        raise GeometryError(f"{origin} must have outward winding throughout, found an enclosed volume of {mesh.volume:.3g} m^3; flip or unify its normals")


def _read_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except (ValueError, IndexError, KeyError, NotImplementedError, UnicodeDecodeError) as error:
        raise GeometryError(f"'{path}' could not be read as a triangle surface: {error}") from error
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
    counts = np.asarray(counts)
    if (counts != 3).any():
        raise GeometryError(f"'{path}' must hold triangles, found faces of {sorted(set(counts.tolist()))} corners; triangulate it first")
    to_world = np.asarray(UsdGeom.XformCache().GetLocalToWorldTransform(meshes[0].GetPrim()))  # acts on row vectors
    vertices = np.asarray(points, dtype=np.float64) @ to_world[:3, :3] + to_world[3, :3]
    return vertices, np.asarray(indices, dtype=np.int64).reshape(-1, 3)
