"""The kinds of solid that come with sdfnet. Each says how its tet mesh is made.

A dataset may bring its own: derive from `MeshedGeometry`, add fields, and return a `TetMesh`.
"""

import hashlib
import logging
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from sdfnet.errors import ConfigurationError, GeometryError
from sdfnet.geometry.bunny import bunny_path, place
from sdfnet.geometry.inspection import closed_outward, inspection, wound_outward
from sdfnet.geometry.surface import Surface, load_surface
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.geometry.tetrahedralise import tetrahedralise
from sdfnet.scene import Geometry

logger = logging.getLogger(__name__)

# The six tets that share the diagonal 0-7 of a cell whose corner k has the offsets (k & 1, k >> 1 & 1, k >> 2).
KUHN_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])

UP_AXES = ("y", "z")
REGULAR_ENERGY = 3.0  # AMIPS, tr(J'J) / det(J)^(2/3), of a regular tet: there is no lower


@dataclass(frozen=True)
class MeshedGeometry(Geometry, ABC):
    """A solid that can be turned into tets."""

    @abstractmethod
    def tet_mesh(self) -> TetMesh:
        """Make the mesh."""

    def inputs_digest(self) -> str:
        """A hash of the files that the mesh is made from, empty when there are none; part of the mesh's name."""
        return ""


@dataclass(frozen=True)
class ClosedSurface(MeshedGeometry):
    """A closed triangle surface filled by fTetWild; without a path the Stanford Bunny (paper section 1)."""

    path: str | None = None  # .obj, .ply, .stl, .off or .usd; none: the bunny of the warp-lang package
    up_axis: str = "y"  # which axis of the file points up: y or z
    x_extent: float | None = 0.1551  # m, the solid is scaled to this length along x; none keeps its size
    foot_depth: float | None = 0.007  # m, how far the lowest point lies under z = 0; none keeps the position
    edge_length: float = 0.05  # wanted edge as a fraction of the bounding box diagonal
    envelope: float = 1e-3  # how far the filled surface may leave the input, same fraction
    stop_energy: float = 50.0  # fTetWild stops improving at this energy; 10 is better shaped and twice as slow
    simplify: bool = True  # let fTetWild simplify the surface first: fewer slivers, so twice the time step
    repair: bool = False  # take a surface with flaws and let fTetWild fill it; what was flawed and the change of volume are logged

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up_axis not in UP_AXES:
            raise ConfigurationError(f"geometry.up_axis must be one of {', '.join(UP_AXES)}; found '{self.up_axis}'")
        if self.x_extent is not None and not 0 < self.x_extent < math.inf:
            raise ConfigurationError(f"geometry.x_extent must be positive and finite, found {self.x_extent} m; null keeps the size of the file")
        if self.foot_depth is not None and not math.isfinite(self.foot_depth):
            raise ConfigurationError(f"geometry.foot_depth must be finite, found {self.foot_depth} m; null keeps the position of the file")
        for name in ("edge_length", "envelope"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigurationError(f"geometry.{name} must lie in (0, 1), a fraction of the bounding box diagonal, found {getattr(self, name)}")
        if not REGULAR_ENERGY < self.stop_energy < math.inf:
            raise ConfigurationError(f"geometry.stop_energy must exceed {REGULAR_ENERGY:g}, that of regular tets, and be finite, found {self.stop_energy}")

    def source(self) -> Path:
        """The file that is read."""
        return bunny_path() if self.path is None else Path(self.path).expanduser()

    def tet_mesh(self) -> TetMesh:
        """Load, check, place, fill. Raises GeometryError for a flawed surface unless `repair` is set; one that is inside out is turned over."""
        surface, name = load_surface(self.source()), f"'{self.source().name}'"
        if self.repair:
            logger.warning("repair: %s has %s; fTetWild fills it all the same", name, "; ".join(inspection(surface).problems()) or "no flaw")
            surface = wound_outward(surface)  # of several bodies fTetWild drops those that are wound inward
        else:
            surface = closed_outward(surface, name)
        placed = place(surface, self.up_axis, self.x_extent, self.foot_depth)
        if self.path is not None:
            logger.info("%s", self._extent(name, surface, placed))
        mesh = tetrahedralise(placed, self.edge_length, self.envelope, self.stop_energy, self.simplify)
        if self.repair:
            before, after = placed.as_trimesh().volume, float(mesh.volumes.sum())
            logger.warning("repair: the surface enclosed %.4g m^3, its tets fill %.4g m^3, a change of %+.2g m^3", before, after, after - before)
        return mesh

    def _extent(self, name: str, surface: Surface, placed: Surface) -> str:
        """How large the solid is, so that a file in other units than metres is seen."""
        size = " x ".join(f"{length:.4g}" for length in np.ptp(placed.vertices, axis=0))
        if self.x_extent is None:
            in_millimetres = float(np.ptp(placed.vertices[:, 0])) / 1000
            return f"{name} is {size} m as its numbers stand; if they are millimetres, set geometry.x_extent={in_millimetres:.4g}"
        file_size = float(np.ptp(surface.vertices[:, 0]))
        return f"{name} is {size} m: its {file_size:.4g} along x are scaled to geometry.x_extent; null keeps its numbers as metres"

    def inputs_digest(self) -> str:
        """The hash of the surface file's bytes; a missing file is reported by `load_surface`."""
        return hashlib.sha256(self.source().read_bytes()).hexdigest()[:12] if self.source().is_file() else ""


@dataclass(frozen=True)
class Box(MeshedGeometry):
    """A box from the origin, cut into cubes of six tets."""

    size: tuple[float, float, float] = (1.0, 1.0, 1.0)  # m
    cells: tuple[int, int, int] = (4, 4, 4)  # along x, y and z

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(0 < length < math.inf for length in self.size):
            raise ConfigurationError(f"geometry.size must be positive and finite, found {self.size} m")

    def tet_mesh(self) -> TetMesh:
        """A regular grid."""
        nodes, tets = kuhn_grid(self.cells)
        return TetMesh(nodes * np.asarray(self.size, dtype=np.float64), tets)


@dataclass(frozen=True)
class Sphere(MeshedGeometry):
    """A ball about the origin: a cube of tets, its shells pulled out to spheres."""

    radius: float = 0.05  # m
    cells: int = 8  # along a diameter

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.radius < math.inf:
            raise ConfigurationError(f"geometry.radius must be positive and finite, found {self.radius} m")

    def tet_mesh(self) -> TetMesh:
        """Each cubic shell becomes a spherical one, which keeps every tet's volume positive."""
        nodes, tets = kuhn_grid((self.cells, self.cells, self.cells))
        centred = 2 * nodes - 1
        length = np.linalg.norm(centred, axis=1, keepdims=True)
        shell = np.abs(centred).max(axis=1, keepdims=True)
        ball = np.divide(centred * shell, length, out=np.zeros_like(centred), where=length > 0)
        return TetMesh(self.radius * ball, tets)


def kuhn_grid(cells: tuple[int, int, int]) -> tuple[Float64[np.ndarray, "nodes 3"], Int64[np.ndarray, "tets 4"]]:
    """Nodes and tets of the unit cube cut into cells[0] x cells[1] x cells[2] cells of six tets each. Raises GeometryError without a cell."""
    if min(cells) < 1:
        raise GeometryError(f"geometry.cells must be at least 1 along every axis, found {cells}")
    counts = np.asarray(cells) + 1
    axes = [np.linspace(0.0, 1.0, count) for count in counts]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.stack(np.meshgrid(*[np.arange(cell) for cell in cells], indexing="ij"), axis=-1).reshape(-1, 1, 3)
    offsets = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    index = np.ravel_multi_index(tuple(np.moveaxis(corner + offsets, -1, 0)), tuple(counts))
    return nodes, index[:, KUHN_TETS].reshape(-1, 4).astype(np.int64)
