"""How often a surface winds round a point: the second opinion on the sign of a distance.

Pseudo-normals ask the nearest triangle, winding numbers ask all of them. The two agree wherever a surface is closed and
does not cross itself.
"""

import numpy as np
from jaxtyping import Float, Float64

from sdfnet.errors import GeometryError
from sdfnet.geometry.distance import DIAGONAL_MARGIN
from sdfnet.geometry.surface import Surface

PAIRS_PER_BLOCK = 1 << 16  # of point and face that are held at once: half a megabyte an array, which stays in the cache


def winding_number(points: Float64[np.ndarray, "points 3"], surface: Surface) -> Float64[np.ndarray, " points"]:
    """The generalised winding number of each point (m): 1 inside a closed surface, 0 outside, 2 where two parts overlap.

    The solid angle of a triangle with corners at a, b, c from the point (van Oosterom and Strackee 1983) is

        tan(angle / 2) = a . (b x c) / (|a||b||c| + (a . b)|c| + (b . c)|a| + (c . a)|b|)

    and the winding number is the sum of the angles over 4 pi. The scalar products come from the edges,
    a . b = (|a|^2 + |b|^2 - |a - b|^2) / 2. A hole makes the number fall smoothly from 1 to 0; on the surface itself it
    has no meaning. Every point asks every face: 40 ns a pair, so not for a million points. Raises GeometryError when a
    point is not finite.
    """
    if not np.isfinite(points).all():
        raise GeometryError(f"points must be finite, found {int((~np.isfinite(points)).any(axis=1).sum())} of {len(points)} that are not; leave them out")
    centre = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    vertices, faces = surface.vertices - centre, surface.faces
    corners = vertices[faces]
    # a . (b x c) is the corners' own product less what the point takes from it through the face's normal.
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    heights = np.einsum("fx,fx->f", normals, corners[:, 0])
    edges = ((corners - np.roll(corners, -1, axis=1)) ** 2).sum(axis=2)  # |a - b|^2, |b - c|^2, |c - a|^2
    winding = np.empty(len(points))
    block = max(1, PAIRS_PER_BLOCK // max(1, len(faces)))
    for start in range(0, len(points), block):
        local = points[start : start + block] - centre
        lengths = np.linalg.norm(vertices - local[:, None], axis=2)
        a, b, c = (lengths[:, faces[:, corner]] for corner in range(3))
        a_b, b_c, c_a = ((first**2 + second**2 - edge) / 2 for first, second, edge in zip((a, b, c), (b, c, a), edges.T, strict=True))
        half_angles = np.arctan2(heights - local @ normals.T, a * b * c + a_b * c + b_c * a + c_a * b)
        winding[start : start + block] = half_angles.sum(axis=1) / (2 * np.pi)
    return winding


def sign_disagreements(points: Float[np.ndarray, "points 3"], distances: Float[np.ndarray, " points"], surface: Surface) -> int:
    """How many points have a signed distance (m) whose sign contradicts their winding number: negative, yet not over 1/2, or the reverse.

    Points nearer to the surface than float32 can tell, `DIAGONAL_MARGIN` of its diagonal, have no side and are not asked.
    Raises GeometryError when a point or a distance is not finite.
    """
    if not np.isfinite(distances).all():
        raise GeometryError(f"distances must be finite, found {int((~np.isfinite(distances)).sum())} of {len(distances)} that are not; measure them again")
    has_side = np.abs(distances) > DIAGONAL_MARGIN * surface.diagonal
    is_inside = winding_number(points[has_side].astype(np.float64), surface) > 0.5
    return int((is_inside != (distances[has_side] < 0)).sum())
