"""An evaluation as a table for the screen, `result.json`, meshes and a picture."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from sdfnet.data.store import write_json, written_whole
from sdfnet.data.versions import versions
from sdfnet.evaluation.evaluate import METHODS, PREFIX, Evaluation
from sdfnet.evaluation.figures import Panel, figure5
from sdfnet.evaluation.metrics import vertex_errors
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.physics.trajectory import Trajectory

TITLES = {"network": "network", "knn1": "KNN-1", "floor": "floor (exact SDF)"}
NOTHING = "no surface"
SHOWN_ERROR_MM = 1.0  # where the scale of the pictures ends
ROWS = (
    ("chamfer_l1_mm", "chamfer L1 (mm)", 3),
    ("accuracy_mm", "accuracy, network to truth (mm)", 3),
    ("completeness_mm", "completeness, truth to network (mm)", 3),
    ("rms_mm", "RMS (mm)", 3),
    ("p99_mm", "99th percentile (mm)", 3),
    ("hausdorff_mm", "Hausdorff (mm)", 3),
    ("normal_degrees", "normals (degrees)", 2),
    ("f_score_0p1_percent", "F-score at 0.1 % of D", 3),
    ("f_score_0p5_percent", "F-score at 0.5 % of D", 3),
    ("f_score_1_percent", "F-score at 1 % of D", 3),
)
NETWORK_ROWS = (  # mean over the volume frames; only a network has a field to ask
    ("intersection_over_union_mean", "volume overlap (IoU)", 4),
    ("volume_error_percent_mean", "volume error (%)", 3),
    ("mae_within_1_percent_mm_mean", "field error within 1 % of D (mm)", 3),
    ("mae_mm_mean", "field error, all samples (mm)", 3),
    ("sign_error_percent_mean", "samples on the wrong side (%)", 3),
    ("eikonal_mean", "gradient length off 1", 3),
)


def result_of(evaluation: Evaluation, trajectory: Trajectory, train_frames: list[int], seconds: Mapping[str, float], run: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that a run found, flat, every unit in its name. `seconds` are added as `<stage>_seconds`, `run` as it is."""
    frames = len(trajectory.times)
    unseen = sorted(set(range(frames)) - set(train_frames))
    return {
        **run,
        **evaluation.summary(unseen),
        **evaluation.networks.sizes(frames),
        "storage": evaluation.networks.storage,
        "knn1_bytes": evaluation.knn1_bytes,
        "diagonal_mm": trajectory.mesh.diagonal * 1e3,
        **{f"{stage.replace(' ', '_')}_seconds": value for stage, value in seconds.items()},
        **{f"evaluate_{stage}_seconds": value for stage, value in evaluation.seconds.items()},
        "evaluation_device": "cpu",
        "threads": torch.get_num_threads(),
        "versions": versions(),
    }


def table_of(result: Mapping[str, Any]) -> Table:
    """The network beside KNN-1 and the floor: mean over the frames and worst frame."""
    table = Table(title=f"{result['frames']:.0f} frames, D = {result['diagonal_mm']:.1f} mm", title_justify="left")
    table.add_column("mean / worst frame")
    for method in METHODS:
        table.add_column(TITLES[method], justify="right")
    for metric, title, digits in ROWS:
        table.add_row(title, *[_cell(result, PREFIX[method], metric, digits) for method in METHODS])
    in_diagonals = [1e3 * result[PREFIX[method] + "chamfer_l1_mm_mean"] / result["diagonal_mm"] for method in METHODS]
    table.add_row("chamfer L1 (1e-3 D)", *[f"{value:.3f}" if math.isfinite(value) else NOTHING for value in in_diagonals])
    for metric, title, digits in NETWORK_ROWS:
        table.add_row(title, f"{result[metric]:.{digits}f}", "", "")
    if "unseen_frames" in result:
        cells = [_cell(result, f"unseen_{PREFIX[method]}", "chamfer_l1_mm", 3) for method in METHODS]
        table.add_row(f"chamfer L1, {result['unseen_frames']:.0f} frames never trained on (mm)", *cells)
    table.add_row("failed frames", *[f"{result[PREFIX[method] + 'failed_frames']:.0f}" for method in METHODS])
    table.add_row(f"size, stored as {result['storage']}", f"{result['query_bytes'] / 1e3:.1f} kB", f"{result['knn1_bytes'] / 1e6:.0f} MB", "the meshes")
    table.add_row("parameters, decoder + encoder", f"{result['decoder_parameters']:,} + {result['encoder_parameters']:,}", "", "")
    return table


def _cell(result: Mapping[str, Any], prefix: str, metric: str, digits: int) -> str:
    """Mean and worst; without a surface in every frame a mean says nothing."""
    if result[f"{prefix}failed_frames"]:
        return NOTHING
    return f"{result[f'{prefix}{metric}_mean']:.{digits}f} / {result[f'{prefix}{metric}_worst']:.{digits}f}"


def write_report(folder: Path, evaluation: Evaluation, result: Mapping[str, Any], trajectory: Trajectory) -> None:
    """Write `result.json`, and for each frame asked for its meshes as .ply and a picture like the paper's Figure 5."""
    write_json(folder / "result.json", result)
    for frame, surfaces in evaluation.surfaces.items():
        for name, surface in surfaces.items():
            with written_whole(folder / "meshes" / f"frame_{frame:03d}_{name}.ply") as unfinished:
                surface.as_trimesh().export(unfinished, file_type="ply")
        truth = SurfaceDistance(trajectory.surface(frame))
        panels = [Panel(surfaces["truth"], None, "truth", f"frame {frame} of {len(trajectory.times) - 1}")]
        if frame in evaluation.failures:
            panels.append(Panel(None, None, TITLES["network"], evaluation.failures[frame]))
        for method in ("network", "knn1"):
            if method in surfaces:
                errors = evaluation.surface_errors[method][frame]
                size = f"{result['query_bytes'] / 1e3:.0f} kB" if method == "network" else f"{result['knn1_bytes'] / 1e6:.0f} MB"
                caption = f"{errors.chamfer_l1_mm:.2f} mm mean error, {size} for all frames"
                panels.append(Panel(surfaces[method], vertex_errors(surfaces[method], truth), TITLES[method], caption))
        figure5(panels, folder / f"figure5_frame_{frame:03d}.png", maximum_mm=SHOWN_ERROR_MM)
