"""Both networks together, as they are trained, saved and read back."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from sdfnet.errors import TrainingError
from sdfnet.models.decoder import SdfCalculator
from sdfnet.models.latents import blank_shapes, latent_source_of
from sdfnet.models.settings import ModelSettings
from sdfnet.models.storage import as_stored, stored_bytes

CHECKPOINT_PREFIX = "networks."
RECORD = "sdfnet"  # the entry of a checkpoint that says what it is of


class Networks(nn.Module):
    """A Mesh Encoder, or what stands for it, and the SDF Calculator that understands its latents (paper section 4)."""

    storage = "float32"  # or what `quantised` rounded decoder and latents to

    def __init__(self, settings: ModelSettings, shapes: Float32[Tensor, "frames vertices 3"], lower: Float32[Tensor, "3"], upper: Float32[Tensor, "3"]) -> None:
        super().__init__()
        self.settings = settings
        self.encoder = latent_source_of(settings, shapes)
        self.decoder = SdfCalculator(settings, lower, upper)

    def forward(self, shapes: Float32[Tensor, "frames vertices 3"], points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "frames points"]:
        """Signed distances (m) of shapes given by their vertices at points (m)."""
        return self.decoder(self.encoder(shapes), points)

    @torch.no_grad()
    def latents(self, shapes: Float32[Tensor, "frames vertices 3"]) -> Float[Tensor, "frames latent"]:
        """The latent vectors as they are stored, without gradients."""
        return as_stored(self.encoder(shapes), self.storage)

    def sizes(self, frames: int) -> dict[str, int]:
        """Parameters of each network, and the bytes that answer a query of any of `frames` shapes: decoder and latents as stored."""
        return {
            "decoder_parameters": self.decoder.parameter_count,
            "encoder_parameters": sum(weights.numel() for weights in self.encoder.parameters()),
            "query_bytes": self.decoder.stored_bytes(self.storage) + stored_bytes(frames, self.settings.latent, self.storage),
        }


def read_checkpoint(path: Path, setting: str = "checkpoint") -> dict[str, Any]:
    """The plain contents of a training checkpoint, which a user gave as `setting`.

    Raises TrainingError when there is none or it is not one of sdfnet's.
    """
    if not path.is_file():
        raise TrainingError(f"no checkpoint at '{path}'; give {setting}=outputs/.../checkpoints/last.ckpt")
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises a dozen kinds for a file that is not its own, some with advice to run code from it
        raise TrainingError(
            f"'{path}' is not a whole checkpoint of sdfnet ({type(error).__name__}): it is cut short or of another program; expected one written by train.py"
        ) from error
    if not isinstance(contents, dict) or RECORD not in contents:
        raise TrainingError(f"'{path}' is a checkpoint of another program, expected one written by train.py")
    return contents


def load_networks(path: Path) -> Networks:
    """The networks of a training checkpoint, of whatever size they were. Raises TrainingError."""
    contents = read_checkpoint(path)
    try:
        settings = ModelSettings(**contents[RECORD]["model"])
        weights = {name.removeprefix(CHECKPOINT_PREFIX): values for name, values in contents["state_dict"].items()}
        networks = Networks(settings, blank_shapes(settings, weights), torch.zeros(3), torch.ones(3))
        networks.load_state_dict(weights)
    except (RuntimeError, KeyError, TypeError) as error:
        raise TrainingError(f"'{path}' does not fit the model that it names: {error}") from error
    return networks
