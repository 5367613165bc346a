"""What each command can be told: one tree of settings per command, against which Hydra checks every key and type."""

from dataclasses import dataclass, field
from typing import Any

import torch
from omegaconf import MISSING

from sdfnet.data.datamodule import SPLITS, BatchSettings
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.evaluate import EvaluationSettings
from sdfnet.models.settings import ModelSettings
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from sdfnet.verification import CASES

ALL_CASES = "all"


@dataclass(frozen=True)
class TrainerSettings:
    """Where and how Lightning runs."""

    accelerator: str = "auto"  # auto, cpu or cuda
    precision: str = "bf16-mixed"  # bf16-mixed or 32-true
    threads: int | None = None  # of PyTorch; none: all cores
    checkpoint_seconds: float = 60.0  # between checkpoints; one more is written at the end
    progress_bar: bool = True

    def __post_init__(self) -> None:
        for name, allowed in (("accelerator", ("auto", "cpu", "cuda")), ("precision", ("bf16-mixed", "32-true"))):
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
    seed: int = 0
    split: str = "all"
    resume: str | None = None
    data_folder: str = "outputs/data"

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise ConfigurationError(f"split must be one of {', '.join(SPLITS)}; found '{self.split}'")


@dataclass(frozen=True)
class EvaluateSettings:
    """python evaluate.py"""

    checkpoint: str = MISSING
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    data_folder: str = "outputs/data"


@dataclass(frozen=True)
class CostSettings:
    """python cost.py"""

    dataset: Any = MISSING  # a Dataset; the plugin's node brings its own types
    model: ModelSettings = field(default_factory=ModelSettings)
    batch: BatchSettings = field(default_factory=BatchSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    precision: str = "bf16-mixed"  # of the training that is timed: bf16-mixed or 32-true
    measure: str = "all"  # all, step or throughput
    duration: float | None = None  # s of the scene that the step study runs; none: all of it
    data_folder: str = "outputs/data"

    def __post_init__(self) -> None:
        if self.measure not in ("all", "step", "throughput"):
            raise ConfigurationError(f"measure must be one of all, step, throughput; found '{self.measure}'")


@dataclass(frozen=True)
class VerifySettings:
    """python verify.py"""

    case: str = ALL_CASES  # or the name of one reference case

    def __post_init__(self) -> None:
        if self.case not in (ALL_CASES, *CASES):
            raise ConfigurationError(f"case must be one of {', '.join((ALL_CASES, *CASES))}; found '{self.case}'")
