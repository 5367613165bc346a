"""The size and kind of the two networks."""

import math
from dataclasses import dataclass

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError

ENCODINGS = ("none", "fourier", "hash_grid", "dense_grid")
ACTIVATIONS = ("relu", "gelu", "silu", "sine", "siren")
CONDITIONINGS = ("first_layer", "modulated")
LATENTS = ("encoder", "pod", "learned")
NAMED = {"encoding": ENCODINGS, "activation": ACTIVATIONS, "conditioning": CONDITIONINGS, "latents": LATENTS}
COUNTED = ("width", "depth", "latent", "frequencies", "grid_levels", "grid_resolution", "grid_features", "grid_table_size", "encoder_width", "encoder_depth")


@dataclass(frozen=True)
class ModelSettings(Checked):
    """What `model.*` sets. The defaults are the paper's networks: 256-256-128 and a latent of 128, no encoding."""

    width: int = 256  # of the SDF Calculator's hidden layers
    depth: int = 3  # how many hidden layers it has
    taper: bool = True  # the last of three or more hidden layers has half the width: 256-256-128
    latent: int = 128  # length of the vector that stands for a shape
    encoding: str = "none"  # of the query point: none, fourier, hash_grid or dense_grid
    frequencies: int = 64  # of the Fourier features; each gives a sine and a cosine
    frequency_scale: float | None = None  # their standard deviation, in radians per mean half side of the box, over pi; none: sqrt(frequencies) / 4
    include_input: bool = False  # the point itself and its distance from the box's centre beside the Fourier features
    activation: str = "relu"  # relu, gelu, silu, sine (sin x) or siren (sin x, with first weights of its own)
    encoder_width: int | None = None  # of the Mesh Encoder's hidden layers; none: the same as width
    encoder_depth: int | None = None  # none: the same as depth
    grid_levels: int = 4  # of the hash grid; the dense grid has one
    grid_resolution: int = 8  # cells along a side of the box: of the dense grid, or of the hash grid's coarsest level
    grid_growth: float = 1.5  # how many times finer each level of the hash grid is than the one before
    grid_features: int = 2  # learned numbers at each grid point of a level
    grid_table_size: int = 2048  # rows of a hash grid's level; one with fewer points has a row for each
    omega: float = 30.0  # of siren: how fast its first waves are, radians per mean half side of the box (Sitzmann et al. 2020, section 3.2)
    conditioning: str = "first_layer"  # first_layer: the latent enters the first layer; modulated: it scales and shifts every hidden layer
    latents: str = "encoder"  # encoder: the Mesh Encoder's; pod: coefficients of the first modes; learned: a free vector for each training frame

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in COUNTED:
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ConfigurationError(f"model.{name} must be at least 1, found {getattr(self, name)}")
        for name, allowed in NAMED.items():
            if getattr(self, name) not in allowed:
                raise ConfigurationError(f"model.{name} must be one of {', '.join(allowed)}; found '{getattr(self, name)}'")
        for name in ("frequency_scale", "omega"):
            if getattr(self, name) is not None and not 0 < getattr(self, name) < math.inf:
                raise ConfigurationError(f"model.{name} must be positive and finite, found {getattr(self, name)}")
        if not 1 <= self.grid_growth < math.inf:
            raise ConfigurationError(f"model.grid_growth must be at least 1 and finite, found {self.grid_growth}")

    @property
    def fourier_scale(self) -> float:
        """The scale of the Fourier features. Few of them must be slow: where they cannot fill the band they ring, far from the surface too."""
        return math.sqrt(self.frequencies) / 4 if self.frequency_scale is None else self.frequency_scale

    @property
    def decoder_widths(self) -> list[int]:
        """The SDF Calculator's hidden widths."""
        return hidden_widths(self.width, self.depth, self.taper)

    @property
    def encoder_widths(self) -> list[int]:
        """The Mesh Encoder's hidden widths."""
        width = self.width if self.encoder_width is None else self.encoder_width
        return hidden_widths(width, self.depth if self.encoder_depth is None else self.encoder_depth, self.taper)

    @property
    def grid_resolutions(self) -> list[int]:
        """Cells along a side of the box, level by level: floor(N b^l) (Mueller et al. 2022, equation 2)."""
        levels = 1 if self.encoding == "dense_grid" else self.grid_levels
        return [int(self.grid_resolution * self.grid_growth**level) for level in range(levels)]


def hidden_widths(width: int, depth: int, taper: bool) -> list[int]:
    """`depth` widths; with `taper` and at least three layers the last is half as wide (paper section 4)."""
    widths = [width] * depth
    if taper and depth >= 3:
        widths[-1] = max(1, width // 2)
    return widths
