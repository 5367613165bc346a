"""The meshes that TensorBoard shows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.util.tensor_util import make_ndarray

from sdfnet.cli import board
from sdfnet.cli.board import add_surface, vertex_colours
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.surface import Surface

BALL = Sphere(radius=0.05, cells=4).tet_mesh().surface()
CLAY, DARK_RED = (239, 231, 218), (77, 10, 38)  # where the colours of Figure 5 begin and end


def scaled(factor: float) -> Surface:
    return Surface(factor * BALL.vertices, BALL.faces)


def test_the_truth_is_clay_and_what_is_a_millimetre_off_has_the_last_colour() -> None:
    truth = SurfaceDistance(BALL)
    assert (vertex_colours(BALL, None) == CLAY).all()
    assert (vertex_colours(BALL, truth) == CLAY).all()
    assert (vertex_colours(scaled(1.03), truth) == DARK_RED).all()  # 1.5 mm, but for the facets
    halfway = vertex_colours(scaled(1.01), truth)
    assert not (halfway == CLAY).all(axis=1).any()
    assert not (halfway == DARK_RED).all(axis=1).any()


def _shown(folder: Path) -> dict[str, Any]:
    events = EventAccumulator(str(folder)).Reload()
    return {tag: make_ndarray(events.Tensors(tag)[0].tensor_proto)[0] for tag in events.Tags()["tensors"]}


def test_a_mesh_has_its_own_vertices_turned_upright_with_a_colour_for_each(tmp_path: Path) -> None:
    logger = TensorBoardLogger(tmp_path, name="", version="board")
    add_surface(logger, "network", BALL, None, 7)
    logger.finalize("success")
    shown = _shown(tmp_path / "board")
    x, y, z = BALL.vertices.astype(np.float32).T
    np.testing.assert_array_equal(shown["network/surface_VERTEX"], np.stack([x, z, -y], axis=1))
    np.testing.assert_array_equal(shown["network/surface_FACE"], BALL.faces)
    np.testing.assert_array_equal(shown["network/surface_COLOR"], np.broadcast_to(CLAY, BALL.vertices.shape))


def test_a_mesh_that_the_page_cannot_draw_is_left_out_with_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(board, "LARGEST_MESH", len(BALL.vertices) - 1)
    logger = TensorBoardLogger(tmp_path, name="", version="board")
    add_surface(logger, "network", BALL, None, 7)
    logger.finalize("success")
    assert "network/surface_VERTEX" not in _shown(tmp_path / "board")
    assert f"frame 7, network: no mesh in TensorBoard, which shows {len(BALL.vertices) - 1} vertices at most; found {len(BALL.vertices)}" in caplog.text
