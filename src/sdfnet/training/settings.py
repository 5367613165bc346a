"""What `training.*` and `optimizer.*` set, with the checks that concern more than one of them."""

import math
from dataclasses import dataclass

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError
from sdfnet.models.settings import ModelSettings
from sdfnet.training.cycle import PAPER_CYCLE, Phase
from sdfnet.training.schedules import PAPER_PLATEAUS, Plateau


@dataclass(frozen=True)
class OptimizerSettings(Checked):
    """Optimisers of the two networks and how their rates change. The defaults are the paper's (Adam is our reading: it names none)."""

    name: str = "adam"  # of the SDF Calculator: adam or soap (Vyas et al. 2024); the Mesh Encoder always has Adam
    encoder_rate: float = 0.0075
    decoder_rate: float = 0.005
    schedule: str = "plateau"  # plateau: the paper's two; linear or cosine: one decay to zero over the whole run
    warmup: float = 0.0  # fraction of a linear or cosine run in which the rates rise
    plateaus: tuple[Plateau, ...] = PAPER_PLATEAUS

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, allowed in (("name", ("adam", "soap")), ("schedule", ("plateau", "linear", "cosine"))):
            if getattr(self, name) not in allowed:
                raise ConfigurationError(f"optimizer.{name} must be one of {', '.join(allowed)}; found '{getattr(self, name)}'")
        for name in ("encoder_rate", "decoder_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigurationError(f"optimizer.{name} must be positive and finite, found {getattr(self, name)}")
        if not 0 <= self.warmup < 1:
            raise ConfigurationError(f"optimizer.warmup must lie in [0, 1), found {self.warmup}")
        if self.warmup > 0 and self.schedule == "plateau":
            raise ConfigurationError("optimizer.warmup belongs to the linear and cosine schedules; set it to 0 with plateaus")


@dataclass(frozen=True)
class TrainingSettings(Checked):
    """How long and on what the networks learn. The defaults are the paper's."""

    epochs: int = 592
    cycle: tuple[Phase, ...] = PAPER_CYCLE
    power: int = 2  # of the error in the loss: 2, as in equation 3, or 1
    focus: float | None = None  # fraction of the diagonal D: errors are divided by 1 + r / (focus D), see sdf_loss; none: all count alike
    latent_weight: float = 1.0  # factor on alpha_latent of equation 8; 0 leaves the latent loss out
    validate_every: int = 1  # epochs between looks at the validation loss
    eikonal_weight: float = 0.0  # of | |grad f| - 1 | in the loss, at every eighth point of a step, in float32 with any precision; 0 leaves it out
    normal_weight: float = 0.0  # of |grad f - n| at 256 vertices of each shape of a step, n the surface's normal; in float32 too; 0 leaves it out
    latent_norm_weight: float = 1e-4  # of the squared length of latents in the loss, with model.latents=learned only
    seconds: float | None = None  # after which training ends, if it is not through with its epochs; linear and cosine rates fall over them; none: no limit

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.cycle or not 0 <= self.latent_weight < math.inf:
            raise ConfigurationError(f"training.cycle needs a phase and latent_weight must not be negative, found {self.cycle} and {self.latent_weight}")
        if self.power not in (1, 2):
            raise ConfigurationError(f"training.power must be 1 or 2, found {self.power}")
        if self.focus is not None and not self.focus > 0:
            raise ConfigurationError(f"training.focus must be positive, found {self.focus}")
        if self.seconds is not None and not self.seconds > 0:
            raise ConfigurationError(f"training.seconds must be positive, found {self.seconds}")
        for name in ("eikonal_weight", "normal_weight", "latent_norm_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigurationError(f"training.{name} must be finite and not negative, found {getattr(self, name)}")
        for name in ("epochs", "validate_every"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"training.{name} must be at least 1, found {getattr(self, name)}")

    def require_trainable(self, model: ModelSettings) -> None:
        """Raise ConfigurationError when a phase trains only an encoder that has nothing to train."""
        if model.latents == "pod" and any(phase.trains == "encoder" for phase in self.cycle):
            raise ConfigurationError(
                "model.latents=pod trains no encoder, found a phase of training.cycle that trains only it; set training.cycle='[{trains: both, epochs: 1}]'"
            )
