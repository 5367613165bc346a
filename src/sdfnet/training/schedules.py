"""Learning rates over time: the paper's two plateau schedulers, or a cosine."""

import math
from dataclasses import dataclass

from torch.optim import Optimizer
from torch.optim.lr_scheduler import ReduceLROnPlateau

from sdfnet.errors import ConfigurationError, TrainingError


@dataclass(frozen=True)
class Plateau:
    """A plateau scheduler with the epochs in which it is listened to (paper section 4, Schedulers). Epochs count from 1, as in the paper."""

    first_epoch: int
    last_epoch: int | None  # inclusive; none: to the end
    watches: str  # batch: every step's loss; validation: the epoch's mean validation loss
    patience: int  # readings without improvement before the rate falls
    factor: float  # what the rate is multiplied by

    def __post_init__(self) -> None:
        if self.watches not in ("batch", "validation"):
            raise ConfigurationError(f"a plateau watches batch or validation, found '{self.watches}'")

    def is_active(self, epoch: int) -> bool:
        """Whether it is listened to in an epoch counted from 0."""
        return self.first_epoch <= epoch + 1 and (self.last_epoch is None or epoch + 1 <= self.last_epoch)

    def scheduler(self, optimizer: Optimizer) -> ReduceLROnPlateau:
        """A PyTorch scheduler with these numbers."""
        return ReduceLROnPlateau(optimizer, factor=self.factor, patience=self.patience)


PAPER_PLATEAUS = (Plateau(3, 19, "batch", 30, 0.92), Plateau(20, None, "validation", 2, 0.75))


def take_reading(scheduler: ReduceLROnPlateau, value: float, what: str) -> None:
    """Give a scheduler a loss. Raises TrainingError when it is not finite: PyTorch would take it for "not better" and cut the rate."""
    if not math.isfinite(value):
        raise TrainingError(f"the {what} must be finite, found {value}; lower the learning rates or look for a frame with bad distances")
    scheduler.step(value)


def cosine(progress: float, warmup: float) -> float:
    """The factor on a learning rate: up from 0 over the fraction `warmup`, then down half a cosine to 0 at progress 1."""
    if progress < warmup:
        return progress / warmup
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (progress - warmup) / (1 - warmup))))
