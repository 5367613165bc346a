"""What a step is asked to make small: the paper's losses and the further terms that the settings ask for, with their weights."""

from dataclasses import dataclass

from jaxtyping import Float, Float32
from torch import Tensor

from sdfnet.data.datamodule import Batch
from sdfnet.models.networks import Networks
from sdfnet.training.losses import alpha_latent, eikonal_loss, latent_loss, latent_norm_loss, normal_loss, sdf_loss
from sdfnet.training.settings import TrainingSettings

# A gradient of a gradient costs about ten times a distance: the eikonal term looks at every eighth point of a step, the
# term of normals at as many vertices of each shape, others at every step.
EIKONAL_STRIDE = 8
NORMALS_PER_SHAPE = 256


@dataclass(frozen=True)
class Objective:
    """The loss of a step, and that of distances alone, for a solid whose diagonal is `diagonal` (m)."""

    settings: TrainingSettings
    diagonal: float

    def of_step(self, networks: Networks, latents: Float[Tensor, "frames latent"], batch: Batch, epoch: int) -> Float32[Tensor, ""]:
        """Equation 1 for a batch whose latents are given, with the terms that are not the paper's."""
        settings = self.settings
        loss = self.of_distances(networks.decoder(latents, batch.points), batch.distances)
        weight = settings.latent_weight * alpha_latent(epoch)
        if weight > 0 and latents.requires_grad and len(latents) > 1:
            loss = loss + weight * latent_loss(latents, batch.frames.to(latents.device))
        if networks.settings.latents == "learned" and latents.requires_grad:
            loss = loss + settings.latent_norm_weight * latent_norm_loss(latents)
        if settings.eikonal_weight > 0:
            loss = loss + settings.eikonal_weight * eikonal_loss(networks.decoder.gradients(latents, batch.points[..., ::EIKONAL_STRIDE, :]))
        if batch.facing is not None:
            loss = loss + settings.normal_weight * normal_loss(networks.decoder.gradients(latents, batch.facing.vertices), batch.facing.normals)
        return loss

    @property
    def normals_per_shape(self) -> int:
        """Vertices of each shape at which a step wants to know the normal."""
        return NORMALS_PER_SHAPE if self.settings.normal_weight > 0 else 0

    def of_distances(self, predicted: Float[Tensor, "frames points"], true: Float32[Tensor, "frames points"]) -> Float32[Tensor, ""]:
        """Absolute errors in hundredths of D, so that rates suit a solid of any size; squared ones in metres, as the paper's."""
        unit = 1.0 if self.settings.power == 2 else self.diagonal / 100
        focus = None if self.settings.focus is None else self.settings.focus * self.diagonal
        return sdf_loss(predicted, true, self.settings.power, focus, unit)
