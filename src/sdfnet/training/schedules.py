"""Learning rates over time: the paper's two plateau schedulers, or a decay to zero."""

import math
from dataclasses import dataclass

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError, TrainingError


@dataclass(frozen=True)
class Plateau(Checked):
    """A plateau scheduler with the epochs in which it is listened to (paper section 4, Schedulers). Epochs count from 1, as in the paper."""

    first_epoch: int
    last_epoch: int | None  # inclusive; none: to the end
    watches: str  # batch: every step's loss; validation: the epoch's mean validation loss
    patience: int  # readings without improvement before the rate falls
    factor: float  # what the rate is multiplied by

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.watches not in ("batch", "validation"):
            raise ConfigurationError(f"a plateau watches batch or validation, found '{self.watches}'")
        if self.patience < 0 or not 0 < self.factor < 1:
            raise ConfigurationError(f"a plateau needs patience of at least 0 and a factor in (0, 1), found {self.patience} and {self.factor}")

    def is_active(self, epoch: int) -> bool:
        """Whether it is listened to in an epoch counted from 0."""
        return self.first_epoch <= epoch + 1 and (self.last_epoch is None or epoch + 1 <= self.last_epoch)

    def scheduler(self, optimizer: Optimizer) -> ReduceLROnPlateau:
        """A PyTorch scheduler with these numbers."""
        return ReduceLROnPlateau(optimizer, factor=self.factor, patience=self.patience)


PAPER_PLATEAUS = (Plateau(3, 19, "batch", 30, 0.92), Plateau(20, None, "validation", 2, 0.75))


def take_reading(scheduler: LRScheduler, value: float, what: str) -> None:
    """Give a scheduler a loss. Raises TrainingError when it is not finite: PyTorch would take it for "not better" and cut the rate."""
    if not math.isfinite(value):
        raise TrainingError(f"the {what} must be finite, found {value}; lower the learning rates or look for a frame with bad distances")
    scheduler.step(value)  # type: ignore[arg-type]  # a plateau scheduler takes a loss where others take an epoch


def decay(kind: str, progress: float, warmup: float) -> float:
    """The factor on a learning rate: up from 0 over the fraction `warmup`, then down to 0 at progress 1, by half a cosine or a straight line."""
    if progress < warmup:
        return progress / warmup
    left = 1 - min(1.0, (progress - warmup) / (1 - warmup))
    return left if kind == "linear" else 0.5 * (1 - math.cos(math.pi * left))
