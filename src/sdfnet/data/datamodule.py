"""The LightningDataModule: `prepare_data` makes the missing files, and every training step is a pure function of seed, epoch and step.

All points and distances live on the device as tensors and are indexed there. A step's content does not depend on what came
before it, so a run that was stopped anywhere resumes exactly.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int64
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader

from sdfnet.data.order import frames_of_step
from sdfnet.data.prepare import PreparedFiles, prepare
from sdfnet.data.settings import SPLITS, BatchSettings
from sdfnet.data.store import DistanceSamples, read_distances, read_trajectory
from sdfnet.errors import ConfigurationError
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Dataset


@dataclass(frozen=True, eq=False)
class Facing:
    """Some vertices (m) of each shape and the unit normals there."""

    vertices: Float32[Tensor, "frames drawn 3"]
    normals: Float32[Tensor, "frames drawn 3"]


@dataclass(frozen=True, eq=False)
class Batch:
    """One training step: some shapes, and distances (m) at points that they share or that each has for itself."""

    frames: Int64[Tensor, " frames"]
    shapes: Float32[Tensor, "frames vertices 3"]
    points: Float32[Tensor, "points 3"] | Float32[Tensor, "frames points 3"]
    distances: Float32[Tensor, "frames points"]
    facing: Facing | None = None  # where it was asked for


class ShapeFamily(LightningDataModule):
    """A dataset's shapes and distances. Frames are numbered by their place in time throughout; `train_frames` says which are trained on."""

    trajectory: Trajectory
    samples: DistanceSamples
    files: PreparedFiles
    _tensors: dict[str, Tensor]

    def __init__(self, dataset: Dataset, folder: Path, batch: BatchSettings, split: str = "all", seed: int = 0) -> None:
        super().__init__()
        self._source: tuple[Dataset, Path] | None = (dataset, folder)
        self._choose(dataset.scene.frame_count, dataset.sampling.near_surface_count, batch, split, seed)

    @classmethod
    def of(cls, trajectory: Trajectory, samples: DistanceSamples, batch: BatchSettings, split: str = "all", seed: int = 0) -> "ShapeFamily":
        """The family of arrays at hand, in a notebook: nothing is prepared or read."""
        family = cls.__new__(cls)
        LightningDataModule.__init__(family)
        family._source = None
        family._choose(len(trajectory.times), len(samples.near_points), batch, split, seed)
        family._lay_out(trajectory, samples)
        return family

    @property
    def steps_per_epoch(self) -> int:
        """Training steps in an epoch."""
        one_pass = -(-len(self.train_frames) // self.batch.stride)
        return one_pass if self.batch.steps_per_epoch is None else self.batch.steps_per_epoch

    def prepare_data(self) -> None:
        """Make the files that are missing (Lightning calls this once, on one process)."""
        if self._source is not None:
            self.files = prepare(*self._source)

    def setup(self, stage: str | None = None) -> None:
        """Read the files and lay the tensors out for training."""
        if hasattr(self, "samples"):
            return
        if not hasattr(self, "files"):  # on every process but the first
            self.prepare_data()
        self._lay_out(read_trajectory(self.files.trajectory), read_distances(self.files.distances))

    @property
    def file_names(self) -> dict[str, str]:
        """The prepared files that training reads, none for arrays at hand; a mesh that is made anew has other names."""
        if self._source is None:
            return {}
        return {"trajectory": self.files.trajectory.name, "distances": self.files.distances.name}

    @property
    def shapes(self) -> Float32[Tensor, "frames vertices 3"]:
        """The surface vertices of every frame, trained on or not, m."""
        return self._tensors["shapes"]

    @property
    def validation(self) -> Batch:
        """All training frames at the held-out points."""
        frames = torch.from_numpy(self.train_frames)
        return Batch(frames, self.shapes[frames], self._tensors["validation_points"], self._tensors["validation_distances"].T[frames])

    def to(self, device: torch.device) -> None:
        """Move every tensor that training reads to a device."""
        self._tensors = {name: values.to(device) for name, values in self._tensors.items()}

    def step(self, epoch: int, step: int, normals_per_shape: int = 0) -> Batch:
        """The batch of a step, the same whenever it is asked for; with so many vertices of each shape and the normals there, if any."""
        settings, count = self.batch, len(self.train_frames)
        places = frames_of_step(count, epoch, step, min(settings.frames_per_step, count), settings.stride, settings.ordered_epochs, self.seed)
        frames = torch.from_numpy(self.train_frames[places])
        if settings.points_per_step is None:
            points, distances = self._own_points(frames)
        else:
            points, distances = self._drawn_points(frames, settings.points_per_step, epoch, step)
        shapes = self.shapes.index_select(0, frames.to(self.shapes.device))
        facing = self._drawn_normals(frames, shapes, normals_per_shape, epoch, step) if normals_per_shape else None
        return Batch(frames, shapes, points, distances, facing)

    def train_dataloader(self) -> DataLoader:
        """The step numbers of an epoch; the LightningModule asks `step` for their content."""
        return DataLoader(range(self.steps_per_epoch), batch_size=None)  # type: ignore[arg-type]

    def val_dataloader(self) -> DataLoader:
        """One validation batch, `validation`."""
        return DataLoader(range(1), batch_size=None)  # type: ignore[arg-type]

    def _choose(self, frames: int, near_count: int, batch: BatchSettings, split: str, seed: int) -> None:
        self.batch, self.seed = batch, seed
        self.train_frames = split_frames(frames, split)
        if batch.near_share > 0 and near_count == 0:
            raise ConfigurationError("batch.near_share asks for points about the surface, but dataset.sampling.near_surface_count gives none to train on")

    def _lay_out(self, trajectory: Trajectory, samples: DistanceSamples) -> None:
        self.trajectory, self.samples = trajectory, samples
        self._tensors = {"shapes": torch.from_numpy(trajectory.surface_vertices.astype(np.float32))}
        self._hold_out()

    def _hold_out(self) -> None:
        """Split both sets of points into training and validation; distances are laid out point by point, for a step reads whole points."""
        generator = np.random.default_rng([self.seed, 3])
        held: dict[str, list[np.ndarray]] = {"points": [], "distances": []}
        sets = {"box": (self.samples.points, self.samples.distances), "near": (self.samples.near_points, self.samples.near_distances)}
        uses_near = self.batch.near_share > 0
        for name, (points, distances) in sets.items():
            share = self.batch.near_share if name == "near" else 1 - self.batch.near_share
            count = min(round(share * self.batch.validation_points), len(points) // 2)
            rows = np.zeros(len(points), dtype=np.bool_)
            rows[generator.permutation(len(points))[:count]] = True
            held["points"].append(points[rows])
            held["distances"].append(distances[:, rows].T)
            if name == "box" and self.batch.points_per_step is None:
                self._keep_own(rows)
            elif name == "box" or uses_near:
                self._tensors[f"{name}_points"] = torch.from_numpy(points[~rows])
                self._tensors[f"{name}_distances"] = torch.from_numpy(np.ascontiguousarray(distances[:, ~rows].T))
        for name, parts in held.items():
            self._tensors[f"validation_{name}"] = torch.from_numpy(np.concatenate(parts))

    def _keep_own(self, held_out: np.ndarray) -> None:
        kept = [row[~held_out[row]] for row in self.samples.kept]
        smallest = min(len(row) for row in kept)
        surplus = np.random.default_rng([self.seed, 5])  # rows are in Morton order: to cut their ends would thin one corner of the box
        self._tensors |= {
            "kept": torch.from_numpy(np.stack([np.delete(row, surplus.choice(len(row), len(row) - smallest, replace=False)) for row in kept])),
            "box_points": torch.from_numpy(self.samples.points),
            "frame_distances": torch.from_numpy(self.samples.distances),
        }

    def _own_points(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        kept = self._tensors["kept"][frames].long()
        return self._tensors["box_points"][kept], self._tensors["frame_distances"][frames].gather(1, kept)

    def _drawn_points(self, frames: Tensor, count: int, epoch: int, step: int) -> tuple[Tensor, Tensor]:
        generator = np.random.default_rng([self.seed, 4, epoch, step])
        near_count = round(self.batch.near_share * count)
        points, distances = [], []
        for name, size in (("near", near_count), ("box", count - near_count)):
            if size > 0:
                pool = self._tensors[f"{name}_points"]
                rows = torch.from_numpy(generator.integers(0, len(pool), size)).to(pool.device)
                points.append(pool.index_select(0, rows))  # copies whole rows: five times as fast as pool[rows]
                distances.append(self._tensors[f"{name}_distances"].index_select(0, rows))
        return torch.cat(points), torch.cat(distances).index_select(1, frames.to(distances[0].device)).T

    def _drawn_normals(self, frames: Tensor, shapes: Tensor, count: int, epoch: int, step: int) -> Facing:
        if "normals" not in self._tensors:
            self._tensors["normals"] = torch.from_numpy(self.trajectory.surface_normals.astype(np.float32)).to(shapes.device)
        drawn = np.random.default_rng([self.seed, 6, epoch, step]).integers(0, shapes.shape[1], count)
        vertices = torch.from_numpy(drawn).to(shapes.device)
        normals = self._tensors["normals"].index_select(0, frames.to(shapes.device))
        return Facing(shapes.index_select(1, vertices), normals.index_select(1, vertices))


def split_frames(frames: int, split: str) -> Int64[np.ndarray, " train"]:
    """The frames that are trained on: all; all but every fifth (interpolation); all but the last fifth (extrapolation)."""
    numbers = np.arange(frames, dtype=np.int64)
    if split == "all":
        return numbers
    if split == "interpolation":
        return numbers[numbers % 5 != 2]
    if split == "extrapolation":
        return numbers[: frames - frames // 5]
    raise ConfigurationError(f"split must be one of {', '.join(SPLITS)}; found '{split}'")
