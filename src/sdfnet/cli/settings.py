"""What each command can be told: one tree of settings per command, against which Hydra checks every key and type."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import MISSING

from sdfnet.cost.sweep_table import Target
from sdfnet.data.settings import SPLITS, BatchSettings
from sdfnet.data.store import key_of
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.settings import EvaluationSettings
from sdfnet.geometry.solids import MeshedGeometry
from sdfnet.models.settings import ModelSettings
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from sdfnet.verification import CASES

ALL_CASES = "all"
PRECISIONS = ("auto", "bf16-mixed", "32-true")
STUDIES = (
    "simulation_time",
    "simulation_space",
    "distances",
    "training",
    "network",
    "queries",
    "reconstruction",
    "throughput",
)  # of cost.py, in the order of the flow
READ_BY = {
    "motion_share": {"simulation_time"},
    "checkpoint": {"network", "queries", "reconstruction"},
    "sweep_folder": {"network"},
}  # studies that read a setting


@dataclass(frozen=True)
class TrainerSettings:
    """Where and how Lightning runs."""

    accelerator: str = "auto"  # auto, cpu or cuda
    precision: str = "auto"  # bf16-mixed, 32-true, or auto: whichever is quicker on this machine
    threads: int | None = None  # of PyTorch; none: all cores
    checkpoint_seconds: float = 60.0  # between checkpoints; one more is written at the end
    progress_bar: bool = True

    def __post_init__(self) -> None:
        for name, allowed in (("accelerator", ("auto", "cpu", "cuda")), ("precision", PRECISIONS)):
            if getattr(self, name) not in allowed:
                raise ConfigurationError(f"trainer.{name} must be one of {', '.join(allowed)}; found '{getattr(self, name)}'")
        if self.accelerator == "cuda" and not torch.cuda.is_available():
            raise ConfigurationError("trainer.accelerator=cuda needs a CUDA device, found none; use auto or cpu")
        if self.threads is not None and self.threads < 1:
            raise ConfigurationError(f"trainer.threads must be at least 1, found {self.threads}")


@dataclass(frozen=True)
class PrepareSettings:
    """python prepare.py"""

    dataset: Any = MISSING  # a Dataset; the plugin's node brings its own types
    plan_only: bool = False
    data_folder: str = "outputs/data"


@dataclass(frozen=True)
class TrainSettings:
    """python train.py"""

    dataset: Any = MISSING  # a Dataset; the plugin's node brings its own types
    model: ModelSettings = field(default_factory=ModelSettings)
    batch: BatchSettings = field(default_factory=BatchSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    trainer: TrainerSettings = field(default_factory=TrainerSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    target: Target = field(default_factory=Target)
    seed: int = 0
    split: str = "all"
    resume: str | None = None
    data_folder: str = "outputs/data"

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:  # what NumPy takes
            raise ConfigurationError(f"seed must lie in [0, {2**32 - 1}], found {self.seed}")
        if self.split not in SPLITS:
            raise ConfigurationError(f"split must be one of {', '.join(SPLITS)}; found '{self.split}'")
        if self.model.latents == "learned" and self.split != "all":
            raise ConfigurationError(
                f"model.latents=learned needs split=all, found split={self.split}: a frame that is not trained on would have no latent; "
                "set split=all, or model.latents=encoder or pod"
            )
        if self.resume == "":
            raise ConfigurationError("resume must name a checkpoint, found nothing behind it; say resume=outputs/.../checkpoints/latest.ckpt, or leave it out")

    @property
    def key(self) -> str:
        """The hash of the settings that change a result, and of the files that the mesh is made from: the same wherever and however often it is run.

        Threads are not in it: they change a result only where seconds end a training, which the table of a sweep says.
        """
        asked = replace(self, resume=None, data_folder="", target=Target(), trainer=TrainerSettings(precision=self.trainer.precision))
        geometry = self.dataset.scene.geometry
        return key_of(asked, geometry.inputs_digest() if isinstance(geometry, MeshedGeometry) else "")


@dataclass(frozen=True)
class EvaluateSettings:
    """python evaluate.py"""

    checkpoint: str = MISSING  # what train.py wrote, such as outputs/train/.../checkpoints/last.ckpt
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    data_folder: str = "outputs/data"


@dataclass(frozen=True)
class CostSettings:
    """python cost.py"""

    dataset: Any = MISSING  # a Dataset; the plugin's node brings its own types
    dataset_name: str = MISSING  # what the report is headed with
    model: ModelSettings = field(default_factory=ModelSettings)
    batch: BatchSettings = field(default_factory=BatchSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    precision: str = "auto"  # of trainings, as trainer.precision of train.py
    studies: tuple[str, ...] = STUDIES
    quick: bool = False  # fewer points of most studies; the default network trains for 40 s at most
    motion_share: float | None = None  # of the scene's duration that simulation_time runs; none: a third, or a fifth when quick
    checkpoint: str | None = None  # the network that is asked and reconstructed, and one more of the network study; none: the default that training makes
    sweep_folder: str | None = None  # the folder of a sweep whose networks enter the network study too
    wanted_mm: tuple[float, ...] = (1.0, 0.3, 0.1)  # accuracies for which the cheapest run is named
    data_folder: str = "outputs/data"

    def __post_init__(self) -> None:
        unknown = [name for name in self.studies if name not in STUDIES]
        if unknown or not self.studies:
            raise ConfigurationError(f"studies must be one of {', '.join(STUDIES)}; found '{unknown[0] if unknown else ''}'")
        for name, studies in READ_BY.items():
            if getattr(self, name) is not None and not studies & set(self.studies):
                readers = " or ".join(sorted(studies))
                raise ConfigurationError(f"{name} is read by studies={readers}, found {', '.join(self.studies)}; add one to studies, or leave {name} out")
        if self.motion_share is not None and not 0 < self.motion_share <= 1:
            raise ConfigurationError(f"motion_share must lie in (0, 1], found {self.motion_share}")
        if self.sweep_folder is not None and not Path(self.sweep_folder).is_dir():
            raise ConfigurationError(f"sweep_folder must be there, found nothing at '{self.sweep_folder}'; give the folder that the sweep printed")
        if self.checkpoint is not None and not Path(self.checkpoint).is_file():
            found = "a folder" if Path(self.checkpoint).is_dir() else "nothing"
            raise ConfigurationError(f"checkpoint must be a file, found {found} at '{self.checkpoint}'; give checkpoint=outputs/.../checkpoints/last.ckpt")
        has_network = self.checkpoint is not None or "training" in self.studies
        needing = [name for name in ("queries", "reconstruction") if name in self.studies]
        if needing and not has_network:
            raise ConfigurationError(f"studies={needing[0]} needs a network, found none; add training to studies, or give checkpoint=...")
        if "network" in self.studies and not has_network and self.sweep_folder is None:
            raise ConfigurationError("studies=network needs a network, found none; add training to studies, or give checkpoint=... or sweep_folder=...")
        if self.precision not in PRECISIONS:
            raise ConfigurationError(f"precision must be one of {', '.join(PRECISIONS)}; found '{self.precision}'")
        if any(not wanted > 0 for wanted in self.wanted_mm):
            raise ConfigurationError(f"wanted_mm must be positive, found {min(self.wanted_mm):g}")


@dataclass(frozen=True)
class VerifySettings:
    """python verify.py"""

    case: str = ALL_CASES  # or the name of one reference case

    def __post_init__(self) -> None:
        if self.case not in (ALL_CASES, *CASES):
            raise ConfigurationError(f"case must be one of {', '.join((ALL_CASES, *CASES))}; found '{self.case}'")
