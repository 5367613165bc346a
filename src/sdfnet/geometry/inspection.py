"""Inspects a surface for all that keeps it from bounding one solid, and refuses it with the places."""

import logging
from dataclasses import dataclass, replace

import numpy as np
from trimesh.graph import connected_component_labels

from sdfnet.errors import GeometryError
from sdfnet.geometry.self_intersection import self_intersections
from sdfnet.geometry.surface import NEARNESS, Surface, near_points, place_text
from sdfnet.geometry.winding import winding_number

logger = logging.getLogger(__name__)

PLACES_NAMED = 3  # of each flaw, so that a message can be read
VOLUME_ROUNDING = 1e-14  # parts of the diagonal cubed: the sign of a smaller volume, such as an open sheet's, says nothing


@dataclass(frozen=True)
class Flaw:
    """How often one kind of flaw occurs, and up to three places of it (m)."""

    count: int = 0
    places: tuple[tuple[float, float, float], ...] = ()

    def told(self, one: str, many: str) -> str:
        """Such as "3 open edges at (0.1, 0, 0), (0.2, 0, 0), (0.1, 0.1, 0) m"."""
        where = ", ".join(place_text(place) for place in self.places)
        return f"{self.count} {one if self.count == 1 else many} {'at' if self.count == len(self.places) else 'such as at'} {where} m"


@dataclass(frozen=True)
class Inspection:
    """What stands between a surface and one solid. Of a surface without faces or with numbers that are not finite the rest is not looked at."""

    faces: int
    not_finite: int = 0  # vertices
    open_edges: Flaw = Flaw()  # of one face only
    crowded_edges: Flaw = Flaw()  # of more than two faces
    turned_faces: Flaw = Flaw()  # wound against the larger part of their component
    inward_faces: Flaw = Flaw()  # of components that are wound inward as a whole (a cavity's outward), the turned ones set right
    crossings: Flaw = Flaw()  # pairs of faces
    near_vertices: Flaw = Flaw()  # nearer than 1e-9 of the diagonal to another
    flat_faces: Flaw = Flaw()  # without area: lower than 1e-9 of the diagonal
    bodies: tuple[int, ...] = ()  # faces of each separate body, the largest first; a cavity is no body

    def problems(self) -> list[str]:
        """Each flaw in words, none for a surface that bounds one solid."""
        if self.faces == 0 or self.not_finite:
            return ["no triangles"] if self.faces == 0 else [f"{self.not_finite} vertices that are not finite"]
        kinds = (
            (self.open_edges, "open edge", "open edges"),
            (self.crowded_edges, "edge shared by more than two faces", "edges shared by more than two faces"),
            (self.turned_faces, "face wound against its neighbours", "faces wound against their neighbours"),
            (self.inward_faces, f"of {self.faces} faces wound inward", f"of {self.faces} faces wound inward"),
            (self.crossings, "pair of faces that cross each other", "pairs of faces that cross each other"),
            (self.near_vertices, "vertex almost upon another", "vertices almost upon another"),
            (self.flat_faces, "face without area", "faces without area"),
        )
        found = [flaw.told(one, many) for flaw, one, many in kinds if flaw.count]
        if len(self.bodies) > 1:
            sizes = ", ".join(str(faces) for faces in self.bodies[:PLACES_NAMED]) + (", ..." if len(self.bodies) > PLACES_NAMED else "")
            found.append(f"{len(self.bodies)} separate bodies of {sizes} faces, which would fly apart with nothing between them (keep one, or join them)")
        return found


def closed_outward(surface: Surface, origin: str) -> Surface:
    """The surface where it bounds one solid; turned over, with a warning, where it is wound inward as a whole and has no other flaw.

    Raises GeometryError, with every problem that `inspection` finds and its places, for every other surface.
    """
    found = inspection(surface)
    if found.inward_faces.count == found.faces and not replace(found, inward_faces=Flaw()).problems():
        logger.warning("%s is wound inward, all %d faces of it, and has no other flaw: it is turned over", origin, found.faces)
        return Surface(surface.vertices, surface.faces[:, ::-1])
    if problems := found.problems():
        raise GeometryError(
            f"{origin} must be a closed surface, found {'; '.join(problems)}; "
            "mend it in a mesh editor, or set dataset.scene.geometry.repair=true to let fTetWild fill it all the same"
        )
    return surface


def inspection(surface: Surface) -> Inspection:
    """Look at a surface for all that keeps it from bounding one solid. Lengths are compared with its diagonal, so that units do not matter."""
    vertices, faces = surface.vertices, surface.faces
    whole = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # a face that names a vertex twice has no edges to speak of
    not_finite = int((~np.isfinite(vertices)).any(axis=1).sum())
    if len(whole) == 0 or not_finite:
        return Inspection(len(whole), not_finite)
    used = np.unique(faces)
    solid = Surface(vertices[used], np.searchsorted(used, whole))
    edges, edge_of, uses = _edges(whole)
    middles, centroids, corners = vertices[edges].mean(axis=1), vertices[whole].mean(axis=1), vertices[faces]
    is_turned, is_inward, bodies = _windings(solid, edge_of, uses)
    crossing = self_intersections(surface)
    return Inspection(
        faces=len(faces),
        open_edges=_flaw(middles[uses == 1]),
        crowded_edges=_flaw(middles[uses > 2]),
        turned_faces=_flaw(centroids[is_turned]),
        inward_faces=_flaw(centroids[is_inward]),
        crossings=_flaw(crossing.places, crossing.count),
        near_vertices=_flaw(solid.vertices[near_points(solid.vertices)]),
        flat_faces=_flaw(corners[_altitudes(corners) < NEARNESS * solid.diagonal].mean(axis=1)),
        bodies=tuple(int(faces_of) for faces_of in np.sort(bodies)[::-1]),
    )


def wound_outward(surface: Surface) -> Surface:
    """The surface with the faces that `inspection` finds turned or wound inward turned over."""
    is_turned, is_inward, _ = _windings(surface, *_edges(surface.faces)[1:])
    return Surface(surface.vertices, np.where((is_turned ^ is_inward)[:, None], surface.faces[:, ::-1], surface.faces))


def _flaw(places: np.ndarray, count: int | None = None) -> Flaw:
    return Flaw(len(places) if count is None else count, tuple((float(x), float(y), float(z)) for x, y, z in places[:PLACES_NAMED]))


def _altitudes(corners: np.ndarray) -> np.ndarray:
    """The smallest altitude of each triangle: twice its area over its longest edge."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.divide(doubled, longest, out=np.zeros_like(doubled), where=longest > 0)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The edges (edges, 2), those of each face (faces, 3), and how many faces use each."""
    edges, edge_of, uses = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_inverse=True, return_counts=True)
    return edges, edge_of.reshape(-1, 3), uses


def _windings(surface: Surface, edge_of: np.ndarray, uses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which faces are turned against their neighbours, which then are wound inward as a whole, and how many faces each body has."""
    vertices, faces, is_turned = surface.vertices, surface.faces, _turned(surface.faces, edge_of, uses)
    to_edges = np.stack([np.repeat(np.arange(len(faces)), 3), len(faces) + edge_of.ravel()], axis=1)
    component = connected_component_labels(to_edges, len(faces) + len(uses))[: len(faces)]  # faces with a common edge hang together
    set_right = Surface(vertices, np.where(is_turned[:, None], faces[:, ::-1], faces))
    corners = (vertices - vertices.mean(axis=0))[set_right.faces]
    volumes = np.bincount(component, np.einsum("ij,ij->i", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) / 6)
    is_body = _depths(set_right, component) % 2 == 0  # the others are cavities, wound the other way
    is_inward = np.where(is_body, volumes, -volumes) < -VOLUME_ROUNDING * surface.diagonal**3
    return is_turned, is_inward[component], np.bincount(component)[is_body]


def _turned(faces: np.ndarray, edge_of: np.ndarray, uses: np.ndarray) -> np.ndarray:
    """Which faces are wound against the larger part of their component.

    Each face appears twice, as given and turned over, and copies that agree across an edge of two faces are joined: a
    component falls into its two windings. One that cannot be wound crosses itself or is open, and is named for that.
    """
    by_edge = np.argsort(edge_of.ravel(), kind="stable")
    first, second = by_edge[uses[edge_of.ravel()[by_edge]] == 2].reshape(-1, 2).T
    is_ascending, count = (faces < np.roll(faces, -1, axis=1)).ravel(), len(faces)
    disagrees = is_ascending[first] == is_ascending[second]  # neighbours run along their edge in opposite directions
    as_given = np.stack([first // 3, second // 3 + count * disagrees], axis=1)
    turned_over = np.stack([first // 3 + count, second // 3 + count * ~disagrees], axis=1)
    winding = connected_component_labels(np.concatenate([as_given, turned_over]), 2 * count)
    component, is_turned = np.minimum(winding[:count], winding[count:]), winding[:count] > winding[count:]
    is_minority = 2 * np.bincount(component, is_turned) <= np.bincount(component)
    return is_turned == is_minority[component]


def _depths(surface: Surface, component: np.ndarray) -> np.ndarray:
    """In how many others each component lies: even for a body, odd for a cavity."""
    corners, count = surface.vertices[surface.faces], int(component.max()) + 1
    lower, upper, depth = np.full((count, 3), np.inf), np.full((count, 3), -np.inf), np.zeros(count, dtype=np.int64)
    np.minimum.at(lower, component, corners.min(axis=1))
    np.maximum.at(upper, component, corners.max(axis=1))
    some_point = corners[np.unique(component, return_index=True)[1], 0]
    for outer in range(count):
        boxed = np.flatnonzero((lower > lower[outer]).all(axis=1) & (upper < upper[outer]).all(axis=1))
        if len(boxed):
            depth[boxed] += np.abs(winding_number(some_point[boxed], Surface(surface.vertices, surface.faces[component == outer]))) > 0.5
    return depth
