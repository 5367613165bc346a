"""The losses of the paper (section 4, equations 1 to 9), computed so that equal and zero latents stay finite, and two that are not the paper's."""

import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

# Equation 4 divides by sqrt(1e-6 + |1 - C|).
LATENT_LOSS_FLOOR = 1e-6
# A latent shorter than this has no direction; it is divided by this instead of by its length.
SHORTEST_LATENT = 1e-6
# Equation 8.
ALPHA_LATENT_START, ALPHA_LATENT_POWER, ALPHA_LATENT_EPOCHS = 0.0005, 1.4, 200


def sdf_loss(
    predicted: Float[Tensor, "frames points"], true: Float32[Tensor, "frames points"], power: int = 2, focus: float | None = None, unit: float = 1.0
) -> Float32[Tensor, ""]:
    """Mean over shapes and points of |predicted - true|^power / weight; equations 2 and 3 with power 2 and no focus.

    `focus` (m) divides each error by 1 + r / focus, so that what lies near a surface counts most. r is the smaller of the
    true distance and the predicted one, the latter 0 where its sign is wrong: a surface that the network alone sees, far
    from the true one, counts as much as the true one does. `unit` (m) is the length in which errors are measured.
    """
    predicted = predicted.float()
    error = (predicted - true) / unit
    if focus is not None:
        nearest = torch.minimum(true.abs(), (predicted.detach() * true.sign()).clamp_min(0))
        error = error / (1 + nearest / focus)
    return error.square().mean() if power == 2 else error.abs().mean()


def one_minus_cosine(first: Float[Tensor, "pairs latent"], second: Float[Tensor, "pairs latent"]) -> Float32[Tensor, " pairs"]:
    """1 - C of equation 5, as half the squared distance of the unit vectors: never negative, exact near C = 1, float32 under autocast too."""
    with torch.autocast(first.device.type, enabled=False):
        first, second = (_unit(vectors.float()) for vectors in (first, second))
        return (first - second).square().sum(dim=-1) / 2


def latent_loss(latents: Float[Tensor, "frames latent"], frames: Int64[Tensor, " frames"]) -> Float32[Tensor, ""]:
    """Equation 4 averaged over each shape and the next in the step: 1 / f_td(t) / sqrt(1e-6 + |1 - C|), t the difference of frame numbers.

    The root's slope at C = 1 is 5e8; there the gap itself has no slope, so the gradient of equal latents is zero, not infinite.
    """
    gap = one_minus_cosine(latents[:-1], latents[1:])
    return (1 / time_scale((frames[1:] - frames[:-1]).abs()) / torch.sqrt(LATENT_LOSS_FLOOR + gap)).mean()


def time_scale(difference: Int64[Tensor, " pairs"]) -> Float32[Tensor, " pairs"]:
    """f_td of equation 6: sqrt(t^2 + 5 t + 10)."""
    t = difference.to(torch.float32)
    return torch.sqrt(t * t + 5 * t + 10)


def alpha_latent(epoch: int) -> float:
    """Equation 8: 0.0005 / (e + 1)^1.4 before epoch 200 (from 0), then nothing."""
    return ALPHA_LATENT_START / (epoch + 1) ** ALPHA_LATENT_POWER if epoch < ALPHA_LATENT_EPOCHS else 0.0


def latent_norm_loss(latents: Float[Tensor, "frames latent"]) -> Float32[Tensor, ""]:
    """Mean squared length of the latents, which keeps learned ones about the origin (DeepSDF, Park et al. 2019, equation 9)."""
    return latents.float().square().sum(dim=-1).mean()


def eikonal_loss(gradients: Float32[Tensor, "frames points 3"]) -> Float32[Tensor, ""]:
    """Mean of | |grad f| - 1 |, zero for a true distance except on its ridges; a gradient of zero has no slope, not an infinite one."""
    return (torch.linalg.vector_norm(gradients, dim=-1) - 1).abs().mean()


def normal_loss(gradients: Float32[Tensor, "frames points 3"], normals: Float32[Tensor, "frames points 3"]) -> Float32[Tensor, ""]:
    """Mean of |grad f - n| on the surface, where a distance's gradient is the outward normal (Gropp et al. 2020, equation 2)."""
    return torch.linalg.vector_norm(gradients - normals, dim=-1).mean()


def _unit(vectors: Tensor) -> Tensor:
    # The root is taken of a clamped value, so that a zero vector has a zero gradient instead of NaN.
    length = vectors.square().sum(dim=-1, keepdim=True).clamp_min(SHORTEST_LATENT**2).sqrt()
    return vectors / length
