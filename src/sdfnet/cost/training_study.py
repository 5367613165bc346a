"""What accuracy costs in training: decoders of several sizes, each trained anew for several budgets of seconds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from sdfnet.cost.studies import Point, Study, Timing
from sdfnet.cost.unseen_points import unseen_near_points
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.errors import TrainingError
from sdfnet.evaluation.field_errors import field_errors
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.models.networks import Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.training.fitting import fit_quietly
from sdfnet.training.module import SdfTraining
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

MEASURED_FRAMES = 11
UNLIMITED_EPOCHS = 100_000  # where a budget of seconds ends the training


@dataclass(frozen=True)
class Budget:
    """A network to train: its width, also its number of frequencies, and for how long; None stands for the user's own setting."""

    width: int | None = None
    seconds: float | None = None
    is_default: bool = False  # whether it stands for the user's own training


FULL = (Budget(16, 20.0), Budget(16, 60.0), Budget(None, 20.0), Budget(None, 60.0), Budget(is_default=True), Budget(128, 60.0), Budget(128, 120.0))
QUICK = (Budget(16, 10.0), Budget(None, 10.0), Budget(None, 40.0, is_default=True))  # the user's own training stops after 40 s


@dataclass(frozen=True, eq=False)
class Trained:
    """A network of the study, for the studies that need one."""

    networks: Networks
    point: Point


def training_study(
    family: ShapeFamily, model: ModelSettings, training: TrainingSettings, optimizer: OptimizerSettings, precision: str, budgets: Sequence[Budget] = FULL
) -> tuple[Study, list[Trained]]:
    """Error against seconds of training, with the networks that were trained; each budget is a run of its own from the same seed.

    The error is that of the distance itself, near the surface and without a grid: what the network adds to what the
    other stages cost. A run that diverges is a failed point.
    """
    points, trained = [], []
    for budget in budgets:
        chosen = model if budget.width is None else replace(model, width=budget.width, frequencies=budget.width)
        limited = _limited(training, budget)
        torch.manual_seed(family.seed)
        module = SdfTraining(family, chosen, limited, optimizer)
        method = f"width {chosen.width}"
        setting, overrides = _length(limited), _overrides(budget, limited)
        try:
            fit_quietly(module, family, limited.epochs, precision, validate_every=limited.validate_every)
        except TrainingError as error:
            points.append(Point(method, setting, overrides=overrides, failure=str(error)))
            continue
        networks = module.networks.eval().cpu()
        counts = {"steps": module.trainer.fit_loop.total_batch_idx + 1, "decoder parameters": networks.decoder.parameter_count}
        seconds = Timing.of([module.train_seconds])
        size = networks.sizes(len(family.shapes))["query_bytes"]
        points.append(Point(method, setting, near_error_mm(networks, family), seconds, counts, size, budget.is_default, overrides))
        trained.append(Trained(networks, points[-1]))
    error_label = "mean error of the distance within 1 % of D of the surface (mm)"
    study = Study("training", "What training costs", error_label, "training on the CPU (s)", tuple(points))
    return study, trained


def near_error_mm(networks: Networks, family: ShapeFamily, frames: int = MEASURED_FRAMES) -> float:
    """Mean over frames of the distance's error at those of `unseen_near_points` within 1 % of D of the true surface, mm."""
    trajectory, latents = family.trajectory, networks.latents(family.shapes.cpu())
    asked, truth, found = unseen_near_points(trajectory, family.samples.box), SurfaceDistance(trajectory.surface(0)), []
    for frame in np.unique(np.linspace(0, len(latents) - 1, frames).round().astype(int)):
        truth.deform(trajectory.surface_vertices[frame])
        predicted = networks.decoder.distances(latents[frame], asked)
        found.append(field_errors(predicted, truth.signed_distance(asked), trajectory.mesh.diagonal).mae_within_1_percent_mm)
    return float(np.mean(found))


def _limited(training: TrainingSettings, budget: Budget) -> TrainingSettings:
    """For how long a budget lets a network train; the user's own training keeps its epochs."""
    if budget.seconds is None:
        return training
    if budget.is_default:
        return replace(training, seconds=min(seconds for seconds in (budget.seconds, training.seconds) if seconds is not None))
    return replace(training, seconds=budget.seconds, epochs=UNLIMITED_EPOCHS)


def _length(limited: TrainingSettings) -> str:
    """How long a network trains, in words."""
    if limited.epochs == UNLIMITED_EPOCHS:
        return f"{limited.seconds:g} s"
    limit = "" if limited.seconds is None else f", {limited.seconds:g} s at most"
    return f"{limited.epochs} epochs{limit}"


def _overrides(budget: Budget, limited: TrainingSettings) -> tuple[str, ...]:
    width = () if budget.width is None else (f"model.width={budget.width}", f"model.frequencies={budget.width}")
    seconds = () if budget.seconds is None else (f"training.seconds={limited.seconds:g}",)
    epochs = (f"training.epochs={limited.epochs}",) if limited.epochs == UNLIMITED_EPOCHS else ()
    return (*width, *seconds, *epochs)
