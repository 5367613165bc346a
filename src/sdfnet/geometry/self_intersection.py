"""Where a surface passes through itself: the pairs of its faces that cross, found fast enough to ask for every frame.

Warp's bounding volume hierarchy, in float32 and widened by its rounding, names the candidates; whether an edge of one
face goes through another is decided in float64. The triangle test follows Moeller (1997), "A fast triangle-triangle
intersection test", edge by edge.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from jaxtyping import Float64, Int64

from sdfnet.errors import GeometryError
from sdfnet.geometry.self_intersection_kernel import crossing_kernel
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.warp_start import start_warp

LISTED = 1024  # pairs that a report names at most; the count is always of all
# The boxes of the hierarchy are float32: eight of its steps at the solid's diagonal.
BOX_MARGIN = 1e-6
# An edge's end nearer to a plane than sixteen float64 steps at the largest coordinate is on it: faces in one plane, turned
# and shifted, lie four steps off it.
PLANE_TOLERANCE = 16 * float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class SelfIntersections:
    """The pairs of faces that cross each other, lower face index first, ascending.

    `count` is of all pairs; `pairs` and `places` hold those listed.
    """

    count: int
    pairs: Int64[np.ndarray, "listed 2"]  # face indices
    places: Float64[np.ndarray, "listed 3"]  # m, the middle of each crossing


class SelfIntersectionSearch:
    """The crossing faces of one surface whose vertices move and whose faces stay.

    Faces without a common vertex cross when an edge of one goes through the other (six tests); faces with one common
    vertex when the edge opposite to it does (two tests). Faces with a common edge are skipped: they could only lie
    upon each other in one plane. Not for that case: faces that touch, or overlap in one plane, are not counted.
    Raises GeometryError without a face and when a vertex is not finite.
    """

    def __init__(self, surface: Surface, device: str = "cpu", listed: int = LISTED) -> None:
        if len(surface.faces) == 0:
            raise GeometryError("self-intersections need at least one face, found none")
        start_warp()
        self._device = device
        self._listed = listed
        faces = surface.faces.astype(np.int32)
        self._faces: wp.array = wp.array(faces, dtype=wp.int32, device=device)
        local = self._centred(surface.vertices)
        self._vertices: wp.array = wp.array(local, dtype=wp.vec3d, device=device)
        self._mesh = wp.Mesh(
            points=wp.array(local.astype(np.float32), dtype=wp.vec3, device=device),
            indices=wp.array(faces.ravel(), dtype=wp.int32, device=device),
            bvh_constructor="sah" if device == "cpu" else "lbvh",  # as in SurfaceDistance
        )

    def deform(self, vertices: Float64[np.ndarray, "vertices 3"]) -> None:
        """Move the surface to new vertex positions (m); the hierarchy is refitted, not rebuilt."""
        local = self._centred(vertices)
        self._vertices.assign(local)
        self._mesh.points.assign(local.astype(np.float32))
        self._mesh.refit()

    def find(self) -> SelfIntersections:
        """Count the pairs and list up to `listed` of them."""
        count, pairs, places = self._launch(self._listed)
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        return SelfIntersections(count, pairs[order].astype(np.int64), places[order] + self._centre)

    def count(self) -> int:
        """How many pairs of faces cross; what a frame's report needs."""
        return self._launch(0)[0]

    def _launch(self, listed: int) -> tuple[int, np.ndarray, np.ndarray]:
        count = wp.zeros(1, dtype=wp.int32, device=self._device)
        pairs = wp.zeros((listed, 2), dtype=wp.int32, device=self._device)
        places = wp.zeros(listed, dtype=wp.vec3d, device=self._device)
        wp.launch(
            crossing_kernel,
            dim=self._faces.shape[0],
            inputs=[self._mesh.id, self._vertices, self._faces, self._box_margin, self._tolerance, count, pairs, places],
            device=self._device,
        )
        found = int(count.numpy()[0])
        return found, pairs.numpy()[:found], places.numpy()[:found]

    def _centred(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices about the middle of their box, where float32 is at its best; sets the tolerances."""
        if not np.isfinite(vertices).all():
            raise GeometryError(f"self-intersections need finite vertices, found {int((~np.isfinite(vertices)).any(axis=1).sum())} that are not")
        lower, upper = vertices.min(axis=0), vertices.max(axis=0)
        self._centre = (lower + upper) / 2
        self._box_margin = BOX_MARGIN * float(np.linalg.norm(upper - lower))
        self._tolerance = PLANE_TOLERANCE * float(np.abs(vertices).max())
        return vertices - self._centre


def self_intersections(surface: Surface) -> SelfIntersections:
    """The pairs of faces of one surface that cross each other. For many frames keep a `SelfIntersectionSearch`."""
    return SelfIntersectionSearch(surface).find()
