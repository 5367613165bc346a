"""What contacts share: how hard they push back against a penetration."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TET_FACES
from sdfnet.physics.elasticity import ElasticModel

LARGEST_PENETRATION = 0.1  # of an edge: more is seen in the shape, and is warned of


@dataclass(frozen=True, eq=False)
class Penalty:
    """How hard each boundary face pushes back: factor * (lambda + 2 mu) / edge, with the mean edge of the face at rest.

    With a factor of 1 a contact gives way as much as a layer of tets of that edge behind it.
    """

    edges: Float64[np.ndarray, " faces"]  # m
    areas: Float64[np.ndarray, " faces"]  # m^2, at rest
    stiffness: Float64[np.ndarray, " faces"]  # Pa/m: pressure for each metre of penetration


def penalty(model: ElasticModel, factor: float) -> Penalty:
    """The penalty of every face of the surface."""
    corners = model.mesh.nodes[model.mesh.boundary_faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return Penalty(edges, areas, factor * wave_moduli(model) / edges)


def wave_moduli(model: ElasticModel) -> Float64[np.ndarray, " faces"]:
    """lambda + 2 mu of the tet behind each boundary face, Pa."""
    mesh, material = model.mesh, model.material
    digits = len(mesh.nodes) ** np.arange(3)  # of a number that names a face by its nodes
    of_tets, wanted = (np.sort(faces, axis=1) @ digits for faces in (mesh.tets[:, TET_FACES].reshape(-1, 3), mesh.boundary_faces))
    order = np.argsort(of_tets)
    behind = order[np.searchsorted(of_tets, wanted, sorter=order)] // len(TET_FACES)
    return np.broadcast_to(material.lame_lambda + 2 * material.lame_mu, len(mesh.tets))[behind]


def check_factor(name: str, factor: float) -> None:
    """Raise ConfigurationError for a stiffness factor that pulls or is no number; zero is the same as no contact."""
    if not (math.isfinite(factor) and factor >= 0):
        raise ConfigurationError(f"{name}.stiffness_factor must be finite and not negative, found {factor}")


def unit(name: str, direction: tuple[float, float, float]) -> Float64[np.ndarray, "3"]:
    """The direction with length one. Raises ConfigurationError when it has none."""
    if not (np.isfinite(direction).all() and np.any(direction)):
        raise ConfigurationError(f"{name} must be finite and not zero, found {tuple(direction)}")
    result: np.ndarray = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    return result
