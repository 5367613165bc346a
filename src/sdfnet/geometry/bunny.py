"""Where the Stanford Bunny comes from, and the paper's frame for it.

The scan is the Stanford Computer Graphics Laboratory's. A closed version of it with 6,102 vertices travels inside the
warp-lang package, so that no download is needed.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sdfnet.errors import GeometryError
from sdfnet.geometry.surface import Surface

# The bounding box of the transformed bunny, paper Table 1, metres: rows minimum and maximum, columns x, y, z.
TABLE_1 = np.array([[0.0, -0.0602, -0.0070], [0.1551, 0.0602, 0.1472]])


def bunny_path() -> Path:
    """The bunny's file inside the installed warp-lang package."""
    from warp.examples import get_asset_directory

    path = Path(get_asset_directory()) / "bunny.usd"
    if not path.is_file():
        raise GeometryError(f"warp-lang was expected to carry the bunny at '{path}'; reinstall warp-lang, or give dataset.scene.geometry.path=")
    return path


def place(surface: Surface, up_axis: str, x_extent: float | None, foot_depth: float | None) -> Surface:
    """Bring a surface into the paper's frame (section 1): z up, x from 0, y centred, the foot `foot_depth` (m) under z = 0.

    `up_axis` is y or z, which of the surface's points up.
    `x_extent` (m) scales the solid to that length along x; None keeps its size. `foot_depth` None keeps its position.
    """
    vertices = surface.vertices
    if up_axis == "y":
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    if x_extent is not None:
        vertices = vertices * (x_extent / np.ptp(vertices[:, 0]))
    if foot_depth is not None:
        lower, upper = vertices.min(axis=0), vertices.max(axis=0)
        vertices = vertices - np.array([lower[0], (lower[1] + upper[1]) / 2, lower[2] + foot_depth])
    return Surface(vertices, surface.faces)


def beside_table_1(nodes: Float64[np.ndarray, "nodes 3"]) -> str:
    """The paper's Table 1 beside the bounding box of our nodes, as text, in metres."""
    ours = np.stack([nodes.min(axis=0), nodes.max(axis=0)])
    rows = ["bounding box (m)   paper minimum   ours   paper maximum   ours"]
    for axis, name in enumerate("xyz"):
        rows.append(f"  {name}{TABLE_1[0, axis]:24.4f}{ours[0, axis]:9.4f}{TABLE_1[1, axis]:14.4f}{ours[1, axis]:9.4f}")
    return "\n".join(rows)
