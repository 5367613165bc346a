"""What TensorBoard shows of a run once it is over."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from lightning.pytorch.loggers import TensorBoardLogger

from sdfnet.data.datamodule import ShapeFamily
from sdfnet.evaluation.evaluate import Evaluation
from sdfnet.evaluation.figures import ERROR_COLOURS
from sdfnet.evaluation.metrics import vertex_errors
from sdfnet.evaluation.report import SHOWN_ERROR_MM
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface
from sdfnet.training.losses import one_minus_cosine

logger = logging.getLogger(__name__)

LARGEST_MESH = 2**16  # vertices: TensorBoard's page keeps corners in 16 bits, and more would be drawn as a tangle
# TensorBoard's own camera cuts off what is nearer than 0.1 m, and its light turns colours white.
STAGE = {
    "camera": {"cls": "PerspectiveCamera", "fov": 30, "near": 0.001, "far": 100.0},
    "lights": [
        {"cls": "AmbientLight", "color": "#ffffff", "intensity": 0.35},
        {"cls": "DirectionalLight", "color": "#ffffff", "intensity": 0.6, "position": [-1.0, 1.0, 2.0]},
    ],
    "material": {"cls": "MeshStandardMaterial", "color": "#ffffff", "roughness": 1.0, "metalness": 0.0},
}


def write_board(board: TensorBoardLogger, family: ShapeFamily, evaluation: Evaluation, result: Mapping[str, Any]) -> None:
    """The last things that TensorBoard shows: cosine to the first frame (Figure 11), meshes, settings with their final metrics."""
    latents = evaluation.networks.latents(family.shapes)
    for frame, gap in enumerate(one_minus_cosine(latents[:1].expand_as(latents), latents).tolist()):
        board.experiment.add_scalar("latent/cosine_to_first_by_frame", 1 - gap, frame)
    for frame, surfaces in evaluation.surfaces.items():
        truth = SurfaceDistance(surfaces["truth"])
        for name, surface in surfaces.items():
            add_surface(board, name, surface, None if name == "truth" else truth, frame)
    plain = {key: value for group in ("model", "optimizer", "training", "batch") for key, value in _flat(result["settings"][group], group)}
    board.log_hyperparams(
        plain | {"seed": result["seed"]}, {f"final/{name}": float(result[name]) for name in ("chamfer_l1_mm_mean", "chamfer_l1_mm_worst", "decoder_parameters")}
    )
    board.finalize("success")


def add_surface(board: TensorBoardLogger, name: str, surface: Surface, truth: SurfaceDistance | None, frame: int) -> None:
    """A mesh in the colours of Figure 5, under its name because the page shows no more than that, and seen from the front with z upwards."""
    count = len(surface.vertices)
    if count > LARGEST_MESH:
        logger.warning("frame %d, %s: no mesh in TensorBoard, which shows %d vertices at most; found %d, open meshes/*.ply", frame, name, LARGEST_MESH, count)
        return
    y_upwards = torch.from_numpy(surface.vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]).float()  # as the page has it
    colours = torch.from_numpy(vertex_colours(surface, truth))
    board.experiment.add_mesh(f"{name}/surface", y_upwards[None], colours[None], torch.from_numpy(surface.faces).int()[None], STAGE, frame)


def vertex_colours(surface: Surface, truth: SurfaceDistance | None) -> UInt8[np.ndarray, "vertices 3"]:
    """Red, green and blue of each vertex by its distance to the truth, on the scale of Figure 5; plain clay where the surface is the truth."""
    errors_mm = np.zeros(len(surface.vertices)) if truth is None else vertex_errors(surface, truth)
    return np.asarray(ERROR_COLOURS(errors_mm / SHOWN_ERROR_MM, bytes=True))[:, :3]


def _flat(settings: Mapping[str, Any], prefix: str) -> list[tuple[str, Any]]:
    return [(f"{prefix}.{key}", value if isinstance(value, str | int | float | bool) else str(value)) for key, value in settings.items() if key != "kind"]
