"""The size and kind of the two networks."""

from dataclasses import dataclass

from sdfnet.errors import ConfigurationError

ENCODINGS = ("none", "fourier")
ACTIVATIONS = ("relu", "gelu", "silu", "sine")


@dataclass(frozen=True)
class ModelSettings:
    """What `model.*` sets. The defaults are the paper's networks: 256-256-128 and a latent of 128, no encoding."""

    width: int = 256  # of the SDF Calculator's hidden layers
    depth: int = 3  # how many hidden layers it has
    taper: bool = True  # the last of three or more hidden layers has half the width: 256-256-128
    latent: int = 128  # length of the vector that stands for a shape
    encoding: str = "none"  # of the query point: none or fourier
    frequencies: int = 64  # of the Fourier features; each gives a sine and a cosine
    frequency_scale: float = 2.0  # their standard deviation, in radians per mean half side of the box, over pi
    activation: str = "relu"  # relu, gelu, silu or sine
    encoder_width: int | None = None  # of the Mesh Encoder's hidden layers; none: the same as width
    encoder_depth: int | None = None  # none: the same as depth

    def __post_init__(self) -> None:
        for name in ("width", "depth", "latent", "frequencies", "encoder_width", "encoder_depth"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ConfigurationError(f"model.{name} must be at least 1, found {getattr(self, name)}")
        for name, allowed in (("encoding", ENCODINGS), ("activation", ACTIVATIONS)):
            if getattr(self, name) not in allowed:
                raise ConfigurationError(f"model.{name} must be one of {', '.join(allowed)}; found '{getattr(self, name)}'")
        if self.frequency_scale <= 0:
            raise ConfigurationError(f"model.frequency_scale must be positive, found {self.frequency_scale}")

    @property
    def decoder_widths(self) -> list[int]:
        """The SDF Calculator's hidden widths."""
        return hidden_widths(self.width, self.depth, self.taper)

    @property
    def encoder_widths(self) -> list[int]:
        """The Mesh Encoder's hidden widths."""
        width = self.width if self.encoder_width is None else self.encoder_width
        return hidden_widths(width, self.depth if self.encoder_depth is None else self.encoder_depth, self.taper)


def hidden_widths(width: int, depth: int, taper: bool) -> list[int]:
    """`depth` widths; with `taper` and at least three layers the last is half as wide (paper section 4)."""
    widths = [width] * depth
    if taper and depth >= 3:
        widths[-1] = max(1, width // 2)
    return widths
