"""What a training step sees, and which frames are trained on."""

from dataclasses import dataclass

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError

SPLITS = ("all", "interpolation", "extrapolation")


@dataclass(frozen=True)
class BatchSettings(Checked):
    """What one training step sees. The defaults are the paper's: a pair of shapes, each with all the points that it kept."""

    frames_per_step: int = 2  # all, where fewer are trained on
    stride: int = 1  # how many frames further the next step starts
    points_per_step: int | None = None  # drawn at random and shared by the step's frames; none: every frame's own kept points
    near_share: float = 0.0  # fraction of the drawn points that come from the set about the surface
    steps_per_epoch: int | None = None  # none: one pass over the frames
    ordered_epochs: int = 6  # epochs in which frames come up, then down, before they are shuffled
    validation_points: int = 4096  # held out of training, seen by every frame at validation

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frames_per_step < 1 or self.stride < 1:
            raise ConfigurationError(f"batch.frames_per_step and stride must be at least 1, found {self.frames_per_step} and {self.stride}")
        for name in ("points_per_step", "steps_per_epoch", "validation_points"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ConfigurationError(f"batch.{name} must be at least 1, found {getattr(self, name)}")
        if not 0 <= self.near_share <= 1:
            raise ConfigurationError(f"batch.near_share must lie in [0, 1], found {self.near_share}")
        if self.points_per_step is None and self.near_share > 0:
            raise ConfigurationError("batch.near_share needs batch.points_per_step; without it every frame has its own kept points")
