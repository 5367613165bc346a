"""python cost.py: every study that is asked for, one page of what they found, and the cheapest whole for a wanted accuracy."""

import logging
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig

from sdfnet.cli.muted import muted
from sdfnet.cli.screen import screen
from sdfnet.cli.settings import STUDIES, CostSettings, TrainSettings
from sdfnet.cost.distance_study import distance_study
from sdfnet.cost.findings import STUDIES_OF_THE_WHOLE, Whole, cheapest_whole, unmeasured
from sdfnet.cost.machine import machine
from sdfnet.cost.network_study import QUICK as QUICK_EFFORT
from sdfnet.cost.network_study import (
    Candidate,
    Effort,
    baseline_candidates,
    measured_shapes,
    network_candidate,
    network_studies,
    networks_trained_on,
    sweep_candidates,
)
from sdfnet.cost.query_study import query_studies
from sdfnet.cost.reconstruction_study import reconstruction_study
from sdfnet.cost.report import text_of, write_report
from sdfnet.cost.simulation_study import simulation_time_study
from sdfnet.cost.space_study import simulation_space_study
from sdfnet.cost.studies import Point, Study
from sdfnet.cost.sweep_report import command_of
from sdfnet.cost.sweep_table import Job, overridden, read_jobs
from sdfnet.cost.throughput import Throughput, measured_throughput
from sdfnet.cost.training_study import FULL, QUICK, Trained, training_study
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.store import described, write_json
from sdfnet.data.versions import versions
from sdfnet.errors import ConfigurationError, SdfnetError
from sdfnet.evaluation.reconstruct import Grid
from sdfnet.models.networks import Networks
from sdfnet.physics.plan import plan
from sdfnet.training.fitting import keep_freed_memory, resolved_precision

logger = logging.getLogger(__name__)

TIME_SHARE, QUICK_TIME_SHARE = 1 / 3, 0.2  # of the motion that the study in time runs: a consistent mass takes tens of milliseconds a step
SPACE_SHARE, QUICK_SPACE_SHARE = 0.1, 0.02  # of the motion that the study in space runs: quadratic tets do too, and take five times the steps


class Bench:
    """What the studies are made on, prepared shapes and the networks that were trained on the way; and each study, by its name in STUDIES."""

    def __init__(self, settings: CostSettings) -> None:
        """Prepare what is missing and plan the scene, which say what there is to warn of.

        Raises ConfigurationError for a checkpoint of another dataset and for a sweep of which no job is finished.
        """
        self.settings = settings
        self.trained: list[Trained] = []
        self.speed: Throughput | None = None
        self.family = ShapeFamily(settings.dataset, Path(settings.data_folder), settings.batch)
        self.family.prepare_data()
        self.family.setup()
        self.limits = plan(settings.dataset.scene, self.family.trajectory.mesh).limits
        self._given = None if settings.checkpoint is None else networks_trained_on(self.family.file_names, Path(settings.checkpoint))
        self._jobs = [] if settings.sweep_folder is None else _finished_jobs(Path(settings.sweep_folder))

    @property
    def networks(self) -> Networks:
        """The network that is asked and reconstructed: of `checkpoint`, else the default that the training study made."""
        if self._given is not None:
            return self._given
        own = [one.networks for one in self.trained if one.point.is_default]
        if not own:
            raise ConfigurationError("this study needs a network, found that no training of the default one went well; give checkpoint=...")
        return own[-1]

    def share_of_motion(self, share: float) -> float:
        """That share of the scene's duration, at least up to its first frame, s."""
        recording = self.settings.dataset.scene.recording
        return max(share, 1 / (recording.frames - 1)) * float(recording.duration)

    def simulation_time(self) -> list[Study]:
        """Error in time against seconds."""
        quick, asked = self.settings.quick, self.settings.motion_share
        duration = self.share_of_motion(asked if asked is not None else QUICK_TIME_SHARE if quick else TIME_SHARE)
        return [simulation_time_study(self.settings.dataset.scene, self.family.trajectory.mesh, duration, quick)]

    def simulation_space(self) -> list[Study]:
        """Error of mesh and elements against seconds."""
        quick, family = self.settings.quick, self.family
        duration = self.share_of_motion(QUICK_SPACE_SHARE if quick else SPACE_SHARE)
        return [simulation_space_study(self.settings.dataset.scene, family.trajectory.mesh, family.files.seconds["tet mesh"], duration, quick)]

    def distances(self) -> list[Study]:
        """Error of signed distances against seconds."""
        return [distance_study(self.family.trajectory, self.settings.dataset.sampling)]

    def training(self) -> list[Study]:
        """Error of networks against seconds of training."""
        asked = self.settings
        study, self.trained = training_study(self.family, asked.model, asked.training, asked.optimizer, asked.precision, QUICK if asked.quick else FULL)
        return [study]

    def network(self) -> list[Study]:
        """Networks beside other ways to keep the shapes. Raises ConfigurationError when there is no network."""
        trajectory, samples = self.family.trajectory, self.family.samples
        effort = QUICK_EFFORT if self.settings.quick else Effort()
        grid = Grid(samples.box.lower, samples.box.upper, effort.resolution)
        networks = self.network_candidates(grid)
        if not networks:
            raise ConfigurationError("this study needs a network, found that no training went well; give checkpoint=...")
        candidates = [*networks, *baseline_candidates(trajectory, samples, grid, effort)]
        return network_studies(measured_shapes(candidates, trajectory, samples, effort))

    def network_candidates(self, grid: Grid) -> list[Candidate]:
        """The networks of the training study, of `checkpoint` and of `sweep_folder`."""
        asked, trajectory = self.settings, self.family.trajectory
        candidates = [
            network_candidate(f"{one.point.method}, {one.point.setting}", one.networks, trajectory, grid, one.point.is_default, one.point.overrides)
            for one in self.trained
        ]
        if self._given is not None:
            candidates.append(network_candidate("the checkpoint", self._given, trajectory, grid))
        if self._jobs:
            as_default = {"model": asked.model, "batch": asked.batch, "optimizer": asked.optimizer, "training": asked.training, "split": "all"}
            candidates += sweep_candidates(self._jobs, trajectory, grid, self.family.file_names, as_default)
        return candidates

    def queries(self) -> list[Study]:
        """Seconds of a query in batches."""
        return query_studies(self.networks, self.family.trajectory, self.family.samples, quick=self.settings.quick)

    def reconstruction(self) -> list[Study]:
        """Error of the grid against seconds of a frame."""
        return [reconstruction_study(self.networks, self.family.trajectory, self.family.samples, self.settings.quick)]

    def throughput(self) -> list[Study]:
        """Speed of training, which stands above the studies and is none."""
        asked = self.settings
        self.speed = measured_throughput(self.family, asked.model, asked.training, asked.optimizer, asked.precision)
        return []


def cost(settings: CostSettings, output: Path) -> None:
    """Make the studies, print what they say, and write the page, the table, the pictures and the text, after each study anew.

    A study that cannot be made stays on the page with its reason, and the others go on. Raises ConfigurationError when none could be made.
    """
    keep_freed_memory()
    load_before = os.getloadavg()[0]
    bench, found, seconds = Bench(settings), list[Study](), dict[str, float]()
    # What they warn of was said when the data were prepared and the scene was planned; every point of every study would say it again.
    with muted("sdfnet.physics", "sdfnet.data"):
        for name in [name for name in STUDIES if name in settings.studies]:  # whatever order was typed
            logger.info("%s: measuring", name)
            began = time.perf_counter()
            found += _made(bench, name)
            seconds[name] = time.perf_counter() - began
            summary = _summary(bench, found, [later for later in STUDIES if later in settings.studies and later not in seconds])
            _write(bench, output, found, summary, seconds, load_before)
    console = screen()
    console.print("\n".join(text_of(found, summary)))
    console.print(f"written to {output}; open {output / 'report.html'}")
    if bench.speed is None and not any(point.is_measured for study in found for point in study.points):
        raise ConfigurationError("at least one study must be made, found that each failed with the reason above")


def _finished_jobs(sweep_folder: Path) -> list[Job]:
    """With a warning for each that is not. Raises ConfigurationError when none is."""
    jobs = read_jobs(sweep_folder)
    if all(job.result is None for job in jobs):
        raise ConfigurationError(f"sweep_folder must hold finished jobs of a sweep, found none of {len(jobs)} in '{sweep_folder}'; give the folder it printed")
    for job in jobs:
        if job.result is None:
            logger.warning("%s is not among the networks, because it is %s%s", job.folder, job.status, job.reason and f": {job.reason}")
    return [job for job in jobs if job.result is not None]


def _made(bench: Bench, name: str) -> list[Study]:
    """The studies of that name, or one with a failed point that says why there is none."""
    try:
        studies: list[Study] = getattr(bench, name)()
    except SdfnetError as error:
        logger.error("%s: %s", name, error)
        return [Study(name, f"{name}: failed", "error (mm)", "cost", (Point(name, "as asked", failure=str(error)),))]
    return studies


def _write(bench: Bench, output: Path, found: Sequence[Study], summary: Sequence[str], seconds: Mapping[str, float], load_before: float) -> None:
    """The page and all that stands beside it, of what is there so far."""
    settings, shapes = bench.settings, bench.family.trajectory
    made_with: dict[str, Any] = {
        "seconds by study": ", ".join(f"{name} {value:.0f}" for name, value in seconds.items()),
        "threads": torch.get_num_threads(),
        "precision of trainings": resolved_precision(settings.precision, "cpu"),
        "load of the machine before and after": f"{load_before:.2f}, {os.getloadavg()[0]:.2f}",
        **machine(),
        **versions(),
    }
    subtitle = f"{len(shapes.times)} frames of {len(shapes.mesh.nodes):,} nodes, D = {1e3 * shapes.mesh.diagonal:.1f} mm; {sum(seconds.values()):.0f} s in all"
    write_report(output, f"What accuracy costs: {settings.dataset_name}", subtitle, found, summary, made_with)
    write_json(output / "cost.json", {"settings": described(settings), "made_with": made_with, "studies": described(found)})


def _summary(bench: Bench, found: Sequence[Study], coming: Sequence[str]) -> list[str]:
    """What stands above the studies: the cheapest whole for each wanted accuracy, step limits and training speed, and which studies are still to come."""
    lines = _cheapest_runs(bench, found)
    if any(study.name == "simulation_time" for study in found):
        lines.append("This integrator has no stability limit." if bench.limits is None else bench.limits.words())
    if bench.speed is not None:
        lines.append(bench.speed.words())
    return lines + ([f"Not measured yet, or stopped before: {', '.join(coming)}."] if coming else [])


def _cheapest_runs(bench: Bench, found: Sequence[Study]) -> list[str]:
    """The cheapest whole for each wanted accuracy with its command; or what it wants, where at least two of its studies were asked for."""
    wholes = [cheapest_whole(found, wanted, bench.family.files.seconds["tet mesh"]) for wanted in bench.settings.wanted_mm]
    if None in wholes and len(STUDIES_OF_THE_WHOLE.keys() & set(bench.settings.studies)) > 1:
        return [f"No cheapest run is named, because these were not measured: {', '.join(unmeasured(found))}."]
    return [line for whole in wholes if whole is not None for line in (whole.words(), _command(whole)) if line]


def _command(whole: Whole) -> str:
    """The command that makes a whole: what was typed for the studies and train.py understands, then what was chosen. Empty without a choice.

    The studies train on the CPU, where train.py would take a GPU that it finds.
    """
    if not whole.points:
        return ""
    of_studies = {entry.name for entry in fields(CostSettings)} - {entry.name for entry in fields(TrainSettings)}
    chosen = [*whole.overrides, "trainer.accelerator=cpu"]
    typed = [f"trainer.{line.lstrip('+')}" if overridden(line) == "precision" else line for line in HydraConfig.get().overrides.task]
    return command_of([line for line in typed if overridden(line) not in of_studies.union(map(overridden, chosen))] + chosen)
