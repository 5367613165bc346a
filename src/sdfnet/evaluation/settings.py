"""How a network is measured."""

from dataclasses import dataclass

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError
from sdfnet.models.storage import STORAGES


@dataclass(frozen=True)
class EvaluationSettings(Checked):
    """What `evaluation.*` sets. The defaults are the paper's 100^3 grid and METRICS' sample counts."""

    resolution: int = 100  # grid points along each axis of the sampling box
    every: int = 1  # measure every so many frames; the last, and those never trained on, always
    surface_samples: int = 131_072  # on each of two surfaces that are compared
    volume_samples: int = 1_000_000  # for the overlap of volumes, on the volume frames only
    volume_frames: int = 3  # how many frames, evenly spaced, get volume, field and eikonal errors
    mesh_frames: tuple[int, ...] = (-1,)  # frames whose meshes are written; negative ones count from the end
    refine_steps: int = 0  # how often each vertex of the network's surface is moved towards where the network itself is zero
    storage: str = "float32"  # what decoder and latents are rounded to before they are measured: float32 (as trained), fp16 or int8

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.every < 1 or self.volume_frames < 1 or self.surface_samples < 1 or self.volume_samples < 1:
            raise ConfigurationError("evaluation.every, volume_frames, surface_samples and volume_samples must each be at least 1")
        if self.resolution < 2:
            raise ConfigurationError(f"evaluation.resolution must be at least 2, found {self.resolution}")
        if self.refine_steps < 0:
            raise ConfigurationError(f"evaluation.refine_steps must be at least 0, found {self.refine_steps}")
        if self.storage not in STORAGES:
            raise ConfigurationError(f"evaluation.storage must be one of {', '.join(STORAGES)}; found '{self.storage}'")

    def require_frames(self, count: int) -> None:
        """Raise ConfigurationError when a frame of `mesh_frames` does not exist among `count`."""
        bad = [frame for frame in self.mesh_frames if not -count <= frame < count]
        if bad:
            raise ConfigurationError(f"evaluation.mesh_frames must lie in [{-count}, {count - 1}] for {count} frames, found {bad}")
