"""The picture: written without a display, all panels on one scale."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread

from sdfnet.errors import ConfigurationError
from sdfnet.evaluation import figures
from sdfnet.evaluation.figures import PANEL_PIXELS, Panel, figure5
from sdfnet.geometry.surface import Surface


def ball() -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    return Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


def middle_of_panels(path: Path, panels: int) -> list[np.ndarray]:
    """Mean colour of the middle of each panel."""
    image = imread(path)[:, :, :3]
    row, half = image.shape[0] // 2, PANEL_PIXELS[0] // 2
    return [image[row - 40 : row + 40, PANEL_PIXELS[0] * panel + half - 40 : PANEL_PIXELS[0] * panel + half + 40].mean(axis=(0, 1)) for panel in range(panels)]


def test_panels_share_one_scale_on_white(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "OVERSAMPLING", 1)
    surface, path = ball(), tmp_path / "figure.png"
    errors = [None, np.zeros(len(surface.vertices)), np.full(len(surface.vertices), 0.5), np.full(len(surface.vertices), 2.0)]
    figure5([Panel(surface, error, f"panel {index}") for index, error in enumerate(errors)], path, maximum_mm=2.0)
    image = imread(path)
    assert image.shape[1] == 4 * PANEL_PIXELS[0]
    assert (image[5, :, :3] == 1).all()
    clay, none, some, most = middle_of_panels(path, 4)
    np.testing.assert_allclose(none, clay, atol=0.02)
    # Larger errors are darker, and the blue of clay goes first.
    assert none.sum() > some.sum() + 0.2 > most.sum() + 0.4
    assert some[0] > some[2] + 0.3
    assert none[2] > 0.6


def test_picture_without_panels_or_scale_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="found 0 panels"):
        figure5([], tmp_path / "figure.png", 1.0)
    with pytest.raises(ConfigurationError, match="and 0.0 mm"):
        figure5([Panel(ball(), None, "truth")], tmp_path / "figure.png", 0.0)
    assert not list(tmp_path.iterdir())
