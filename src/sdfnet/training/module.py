"""The LightningModule: it wires networks, cycle, schedules and losses together, and holds no mathematics of its own."""

import logging
import statistics
import time
from dataclasses import asdict, replace
from typing import Any

import torch
from jaxtyping import Float
from lightning import LightningModule
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from sdfnet.data.datamodule import Batch, ShapeFamily
from sdfnet.errors import ConfigurationError, TrainingError
from sdfnet.models.networks import RECORD, Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.training.checkpoints import require_same_run
from sdfnet.training.cycle import PhaseAt, phase_at
from sdfnet.training.divergence import loses_surface, require_finite_gradients, require_finite_loss, require_finite_validation
from sdfnet.training.losses import one_minus_cosine
from sdfnet.training.objective import Objective
from sdfnet.training.optimizers import decoder_optimizer, encoder_optimizer
from sdfnet.training.schedules import decay, take_reading
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

logger = logging.getLogger(__name__)

FRAMES_PER_VALIDATION_CHUNK = 4
TRAIN_SECONDS = "sdfnet_train_seconds"  # the entry with the seconds of training up to then
EPOCH_LOSSES = "sdfnet_epoch_losses"  # the entry of a checkpoint that holds the losses of the epoch under way


class SdfTraining(LightningModule):
    """Trains the Mesh Encoder and the SDF Calculator (paper section 4) with manual optimisation, because they take turns.

    The networks are made when the data are there, because their size follows the mesh. A checkpoint says in plain values
    what the networks are and which prepared files they were trained on.
    """

    networks: Networks
    train_seconds = 0.0

    def __init__(self, family: ShapeFamily, model: ModelSettings, training: TrainingSettings, optimizer: OptimizerSettings) -> None:
        super().__init__()
        training.require_trainable(model)
        self.automatic_optimization = False
        self._family, self._model, self._training, self._optimizer = family, model, training, optimizer
        self._entered: PhaseAt | None = None
        self._fixed_latents: Tensor | None = None
        self._epoch_losses: list[float] = []
        self._validation_losses: Tensor | None = None
        self._lost_frames: list[int] = []

    def configure_model(self) -> None:
        """Make the networks for the mesh at hand (Lightning calls this after the data are set up). Raises ConfigurationError."""
        family = self._family
        if not hasattr(self, "networks"):
            if self._model.latents == "learned" and len(family.train_frames) < len(family.shapes):
                raise ConfigurationError(
                    "model.latents=learned has no latent for a frame that is not trained on; set split=all, or model.latents=encoder or pod"
                )
            lower, upper = (torch.from_numpy(corner).float() for corner in (family.samples.box.lower, family.samples.box.upper))
            self.networks = Networks(self._model, family.shapes[family.train_frames], lower, upper)
        self._objective = Objective(self._training, family.trajectory.mesh.diagonal)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say what this is a checkpoint of."""
        checkpoint[RECORD] = self.identity()
        checkpoint[EPOCH_LOSSES] = self._epoch_losses
        checkpoint[TRAIN_SECONDS] = time.perf_counter() - self._began if self.trainer.training else self.train_seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take up where the run stopped. Raises TrainingError when it was another run, or where Lightning cannot go on exactly."""
        if RECORD not in checkpoint:
            raise TrainingError("the checkpoint is of another program, expected one written by train.py")
        self.require_resumable(checkpoint[RECORD])
        last_step = checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]
        if last_step["is_last_batch"] and last_step["current"]["completed"] < last_step["current"]["processed"]:
            raise TrainingError(
                f"the checkpoint was written between the last step of epoch {checkpoint['epoch']} and its end, where Lightning loses count and leaves out the "
                "validation; resume from one that TimedCheckpoint wrote, or one of an epoch's end"
            )
        self._epoch_losses = list(checkpoint[EPOCH_LOSSES])
        self.train_seconds = float(checkpoint[TRAIN_SECONDS])

    def identity(self) -> dict[str, Any]:
        """What a resumed run must share with the one that was stopped: settings, frames and, once they are there, the prepared files.

        More epochs are allowed, unless the rates are planned over all of them.
        """
        family, training = self._family, asdict(self._training)
        if self._optimizer.schedule == "plateau":
            del training["epochs"]
        return {
            "model": asdict(self._model),
            "optimizer": asdict(self._optimizer),
            "training": training,
            "batch": asdict(family.batch),
            "seed": family.seed,
            "train_frames": family.train_frames.tolist(),
            **(family.file_names if hasattr(family, "samples") else {}),
        }

    def require_resumable(self, record: dict[str, Any]) -> None:
        """Raise TrainingError when `record`, the identity that a checkpoint holds, is not that of this run."""
        asked = self.identity()
        require_same_run(_with_later_settings(record, asked), asked)

    def configure_optimizers(self) -> Any:
        """One optimiser a network; with plateaus, one scheduler a plateau and network: four objects for the paper's two."""
        settings = self._optimizer
        optimizers = [encoder_optimizer(settings, self.networks.encoder), decoder_optimizer(settings, self.networks.decoder)]
        plateaus = settings.plateaus if settings.schedule == "plateau" else ()
        return optimizers, [plateau.scheduler(optimizer) for plateau in plateaus for optimizer in optimizers]

    def on_train_start(self) -> None:
        """Move the data to the device that training runs on, once."""
        self._family.to(self.device)
        self._entered = None
        self._began = time.perf_counter() - self.train_seconds
        self.trainer.should_stop = self._share_of_seconds() >= 1  # a run that goes on after its last step only ends again

    def on_train_end(self) -> None:
        """Note how long training took, what came before a resume included; say so when frames have no surface."""
        self.train_seconds = time.perf_counter() - self._began
        if self._lost_frames:
            logger.warning(
                "the network had no surface in frames %s when it was last validated: there its distances have one sign; train longer", self._lost_frames
            )

    @property
    def phase(self) -> PhaseAt:
        """Which networks train in this epoch; modes never do."""
        phase = phase_at(self._training.cycle, self.current_epoch)
        return replace(phase, trains="decoder") if self._model.latents == "pod" else phase

    def on_train_batch_start(self, step: int, step_index: int) -> None:
        """Where a phase begins, freeze the network whose turn it is not; compute the latents once when only the decoder trains.

        Asked before every step, because Lightning begins no epoch when it resumes in the middle of one.
        """
        if step_index == 0:
            self._epoch_losses = []
        phase = self.phase
        if phase == self._entered:
            return
        self._entered = phase
        for network, trains in ((self.networks.encoder, phase.trains_encoder), (self.networks.decoder, phase.trains_decoder)):
            network.requires_grad_(trains)
            network.zero_grad(set_to_none=True)
        self._fixed_latents = None if phase.trains_encoder else self.networks.latents(self._family.shapes)

    def training_step(self, step: int, step_index: int) -> None:
        """One step of whichever networks train. Raises TrainingError when the loss or a gradient is not finite."""
        batch, where = self._family.step(self.current_epoch, step_index, self._objective.normals_per_shape), f"epoch {self.current_epoch}, step {step_index}"
        phase = self.phase
        if self._optimizer.schedule != "plateau":
            self._set_decayed_rates(step_index)
        loss = self._objective.of_step(self.networks, self._latents(batch), batch, self.current_epoch)
        value = float(loss.detach())
        require_finite_loss(value, self.networks, batch, where)
        encoder_optimizer, decoder_optimizer = self._both_optimizers()
        active = [one for one, trains in ((encoder_optimizer, phase.trains_encoder), (decoder_optimizer, phase.trains_decoder)) if trains]
        for optimizer in active:
            optimizer.zero_grad(set_to_none=True)
        self.manual_backward(loss)
        require_finite_gradients(self.networks, batch, where)
        with torch.autocast(self.device.type, enabled=False):  # Lightning calls this under bf16; optimisers compute in float32
            for optimizer in active:
                optimizer.step()
        self._epoch_losses.append(value)
        self._read_plateaus("batch", value)
        self.trainer.should_stop = self._share_of_seconds() >= 1

    def on_train_epoch_end(self) -> None:
        """Log the epoch: losses as in Figure 4, rates, phase, latent cosine."""
        encoder_optimizer, decoder_optimizer = self._both_optimizers()
        readings = {
            "loss/train_mean": statistics.fmean(self._epoch_losses),
            "loss/train_max": max(self._epoch_losses),
            "rate/encoder": encoder_optimizer.param_groups[0]["lr"],
            "rate/decoder": decoder_optimizer.param_groups[0]["lr"],
            "phase/encoder_trains": float(self.phase.trains_encoder),
            "phase/decoder_trains": float(self.phase.trains_decoder),
        }
        if self._validation_losses is not None:
            readings |= {"loss/validation_mean": self._validation_losses.mean(), "loss/validation_max": self._validation_losses.max()}
            readings["validation/frames_without_surface"] = len(self._lost_frames)
            latents = self.networks.latents(self._family.shapes) if self._fixed_latents is None else self._fixed_latents
            readings["latent/cosine_first_to_last"] = 1 - one_minus_cosine(latents[:1], latents[-1:])[0]
            self._validation_losses = None
        for board in self.loggers:
            board.log_metrics({name: float(value) for name, value in readings.items()}, step=self.current_epoch)

    def validation_step(self, step: int, step_index: int) -> None:
        """The SDF loss of every training frame at the held-out points. Raises TrainingError when one is not finite."""
        batch = self._family.validation
        latents = self._latents(batch)
        encoded = self.networks.decoder.encoded(batch.points)
        losses, is_lost = [], []
        for some, trues in zip(latents.split(FRAMES_PER_VALIDATION_CHUNK), batch.distances.split(FRAMES_PER_VALIDATION_CHUNK), strict=True):
            predicted = self.networks.decoder.from_encoded(some, encoded)
            losses += [self._objective.of_distances(row[None], true[None]) for row, true in zip(predicted, trues, strict=True)]
            is_lost.append(loses_surface(predicted, trues))
        self._validation_losses = torch.stack(losses)
        self._lost_frames = batch.frames[torch.cat(is_lost).cpu()].tolist()
        require_finite_validation(self._validation_losses, batch.frames.tolist(), f"epoch {self.current_epoch}")

    def on_validation_epoch_end(self) -> None:
        """The second plateau listens to the mean over the frames (paper section 4, Scheduler 2)."""
        if self._validation_losses is not None and not self.trainer.sanity_checking:
            self.log("validation_loss", self._validation_losses.mean(), prog_bar=True, logger=False)
            self._read_plateaus("validation", float(self._validation_losses.mean()))

    def _latents(self, batch: Batch) -> Float[Tensor, "frames latent"]:
        return self.networks.encoder(batch.shapes) if self._fixed_latents is None else self._fixed_latents[batch.frames]

    def _set_decayed_rates(self, step_index: int) -> None:
        steps = self._family.steps_per_epoch
        done = max((self.current_epoch * steps + step_index) / (self._training.epochs * steps), self._share_of_seconds())
        factor = decay(self._optimizer.schedule, done, self._optimizer.warmup)
        for optimizer, rate in zip(self._both_optimizers(), (self._optimizer.encoder_rate, self._optimizer.decoder_rate), strict=True):
            for group in optimizer.param_groups:
                group["lr"] = rate * factor

    def _share_of_seconds(self) -> float:
        """How much of its time training has used; 0 where it has no limit."""
        return 0.0 if self._training.seconds is None else (time.perf_counter() - self._began) / self._training.seconds

    def _read_plateaus(self, watches: str, loss: float) -> None:
        if self._optimizer.schedule != "plateau":
            return
        schedulers = [configured.scheduler for configured in self.trainer.lr_scheduler_configs]
        for index, plateau in enumerate(self._optimizer.plateaus):
            if plateau.watches == watches and plateau.is_active(self.current_epoch):
                for scheduler in schedulers[2 * index : 2 * index + 2]:
                    take_reading(scheduler, loss, f"{watches} loss of epoch {self.current_epoch}")

    def _both_optimizers(self) -> tuple[LightningOptimizer, LightningOptimizer]:
        encoder_optimizer, decoder_optimizer = self.optimizers()  # type: ignore[attr-defined]
        return encoder_optimizer, decoder_optimizer


def _with_later_settings(saved: dict[str, Any], asked: dict[str, Any]) -> dict[str, Any]:
    """What a checkpoint says of its run; settings that did not exist when it was written had the values that are defaults now."""
    defaults = {"model": asdict(ModelSettings()), "training": asdict(TrainingSettings())}
    return saved | {group: {name: defaults[group][name] for name in asked[group]} | saved[group] for group in defaults if group in saved}
