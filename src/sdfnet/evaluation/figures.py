"""The picture of the result, like the paper's Figure 5: surfaces side by side, coloured by their error on one scale."""

import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyvista
from jaxtyping import Float64
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from vtkmodules.vtkCommonCore import vtkLogger

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.surface import Surface

# From clay, which shows the shading where there is no error, through amber to dark red.
ERROR_COLOURS = LinearSegmentedColormap.from_list("error", ["#efe7da", "#f6c667", "#ea7a35", "#b3242b", "#4d0a26"])
CLAY = "#efe7da"
TEXT = "#22262b"
# The camera looks at the face, which is at small x, from the front left and a little above; z is up.
VIEW_DIRECTION = np.array([-0.62, -1.0, 0.34])
VIEW_ANGLE = 18.0  # degrees; a long lens, so that the panels differ by shape and not by perspective
PANEL_PIXELS = (600, 560)
OVERSAMPLING = 2  # rendered this many times larger than shown
DOTS_PER_INCH = 100
CAPTION_COLUMNS = 40  # letters that fit across a panel


@dataclass(frozen=True, eq=False)
class Panel:
    """One surface of the picture; a method without a surface keeps its place, and its caption says why."""

    surface: Surface | None
    errors_mm: Float64[np.ndarray, " vertices"] | None  # None: plain clay, for the truth
    title: str
    caption: str = ""  # a smaller line under the title, for the numbers


def figure5(panels: list[Panel], path: Path, maximum_mm: float) -> None:
    """Write the panels side by side to a .png, one camera and one colour scale from 0 to `maximum_mm` for all.

    Rendered off-screen; needs no display. Errors above the scale take its last colour and the bar says so with an arrow.
    Raises ConfigurationError when there is no panel with a surface or the scale is empty.
    """
    surfaces = [panel.surface for panel in panels if panel.surface is not None]
    if not surfaces or not maximum_mm > 0:
        raise ConfigurationError(f"the picture needs a panel with a surface and a scale above 0 mm, found {len(surfaces)} panels and {maximum_mm} mm")
    corners = np.concatenate([surface.vertices for surface in surfaces])
    camera = _camera(corners)
    width, height = PANEL_PIXELS[0] * len(panels), PANEL_PIXELS[1] + 140
    figure = Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH, facecolor="white")
    FigureCanvasAgg(figure)
    for column, panel in enumerate(panels):
        left, centre = column / len(panels), (column + 0.5) / len(panels)
        figure.text(centre, 1 - 22 / height, panel.title, ha="center", va="top", fontsize=21, fontweight="bold", color=TEXT)
        if panel.surface is None:
            figure.text(centre, 0.5, textwrap.fill(panel.caption, CAPTION_COLUMNS), ha="center", va="center", fontsize=15, color=TEXT)
            continue
        image = figure.add_axes((left, 80 / height, 1 / len(panels), PANEL_PIXELS[1] / height))
        image.imshow(_render(panel.surface, panel.errors_mm, camera, maximum_mm), interpolation="lanczos")
        image.set_axis_off()
        figure.text(centre, 1 - 60 / height, panel.caption, ha="center", va="top", fontsize=15, color=TEXT)
    bar = figure.add_axes((0.5 - 300 / width, 58 / height, 600 / width, 14 / height))
    colours = figure.colorbar(ScalarMappable(Normalize(0, maximum_mm), ERROR_COLOURS), cax=bar, orientation="horizontal", extend="max")
    colours.set_label("distance to the true surface (mm)", fontsize=14, color=TEXT)
    colours.outline.set_visible(False)
    bar.tick_params(labelsize=13, colors=TEXT, length=3)
    figure.savefig(path)


def _camera(corners: np.ndarray) -> pyvista.Camera:
    """A camera that sees all the points, as large as the panel allows."""
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    forward = -VIEW_DIRECTION / np.linalg.norm(VIEW_DIRECTION)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    across, along = (corners - centre) @ right, (corners - centre) @ up
    centre = centre + (across.min() + across.max()) / 2 * right + (along.min() + along.max()) / 2 * up
    half_height = max(np.ptp(along), np.ptp(across) * PANEL_PIXELS[1] / PANEL_PIXELS[0]) / 2
    distance = 1.04 * half_height / np.tan(np.radians(VIEW_ANGLE / 2)) + np.ptp((corners - centre) @ forward) / 2
    camera = pyvista.Camera()
    camera.view_angle = VIEW_ANGLE
    camera.focal_point = tuple(centre)
    camera.position = tuple(centre - distance * forward)
    camera.up = (0.0, 0.0, 1.0)
    return camera


def _render(surface: Surface, errors_mm: Float64[np.ndarray, " vertices"] | None, camera: pyvista.Camera, maximum_mm: float) -> np.ndarray:
    """A surface as an image (rows, columns, 3): a soft key light from the left, a fill, and a rim behind."""
    # Without a display VTK warns before it falls back to rendering in memory.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    plotter = pyvista.Plotter(off_screen=True, window_size=[pixels * OVERSAMPLING for pixels in PANEL_PIXELS], lighting="none")
    plotter.background_color = pyvista.Color("white")
    mesh = pyvista.PolyData.from_regular_faces(surface.vertices, surface.faces)
    plotter.add_mesh(
        mesh,
        color=CLAY if errors_mm is None else None,
        scalars=errors_mm,
        clim=(0, maximum_mm),
        cmap=ERROR_COLOURS,
        show_scalar_bar=False,
        smooth_shading=True,
        ambient=0.22,
        diffuse=0.9,
        specular=0.1,
        specular_power=10,
    )
    plotter.camera = camera
    size = np.linalg.norm(np.ptp(surface.vertices, axis=0))
    for direction, intensity in (((-0.7, 0.9, 1.0), 0.72), ((1.0, 0.1, 0.8), 0.4), ((0.1, 1.0, -0.6), 0.3)):
        plotter.add_light(pyvista.Light(position=tuple(size * 10 * np.array(direction)), intensity=intensity, light_type="camera light"))
    plotter.renderer.enable_ssao(radius=0.06 * size, bias=0.002 * size, kernel_size=64, blur=True)
    plotter.renderer.ResetCameraClippingRange()
    plotter.show(auto_close=False)
    image = np.asarray(plotter.image)
    plotter.close()
    return image
