"""Stops a training that diverged, and says where: which layer was the first, or which frame's data.

Asked for a reason only when there is one; otherwise a step pays for one look at the loss and one at the gradients.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn

from sdfnet.data.datamodule import Batch
from sdfnet.errors import TrainingError
from sdfnet.models.networks import Networks

LOWER_RATES = "lower optimizer.encoder_rate and decoder_rate"


def require_finite_loss(loss: float, networks: Networks, batch: Batch, where: str) -> None:
    """Raise TrainingError when the loss of a step is not finite.

    The message names the batch's frames and what in them is not finite, or else the first layer whose output is not.
    """
    if not math.isfinite(loss):
        raise TrainingError(f"{where}: the loss must be finite, found {loss} on frames {batch.frames.tolist()}; {_reason(networks, batch)}")


def require_finite_gradients(networks: Networks, batch: Batch, where: str) -> None:
    """Raise TrainingError when a gradient is not finite, before a step is taken with it.

    The message names the first layer that the bad gradient reached on its way back from the loss.
    """
    gradients = {name: weights.grad for name, weights in networks.named_parameters() if weights.grad is not None}
    if not gradients or math.isfinite(float(torch.stack([gradient.sum() for gradient in gradients.values()]).sum())):
        return
    bad = [name.rpartition(".")[0] for name, gradient in gradients.items() if not gradient.isfinite().all()]
    if bad:  # large finite ones may add up to infinity
        frames = batch.frames.tolist()
        message = f"{where}: gradients must be finite on frames {frames}; on the way back from the loss the first layer where one is not is {bad[-1]}"
        raise TrainingError(f"{message}; {LOWER_RATES}")


def require_finite_validation(losses: Float32[Tensor, " frames"], frames: Sequence[int], where: str) -> None:
    """Raise TrainingError when the validation loss of a frame is not finite."""
    bad = [frame for frame, loss in zip(frames, losses.tolist(), strict=True) if not math.isfinite(loss)]
    if bad:
        raise TrainingError(f"{where}: the validation loss must be finite, found it is not for frames {bad}; {LOWER_RATES}, or look for bad distances there")


def first_layer_without_finite_output(networks: Networks, batch: Batch) -> str | None:
    """The path of the first layer, in the order in which they run, that gives a number that is not finite; none when all are finite."""
    found: list[str] = []

    def listener(name: str) -> Callable[[nn.Module, Any, Tensor], None]:
        def listen(layer: nn.Module, inputs: Any, output: Tensor) -> None:
            if not output.isfinite().all():
                found.append(name)

        return listen

    handles = [layer.register_forward_hook(listener(name)) for name, layer in networks.named_modules() if not list(layer.children())]
    try:
        with torch.no_grad():
            networks.decoder(networks.encoder(batch.shapes), batch.points)
    finally:
        for handle in handles:
            handle.remove()
    return found[0] if found else None


def loses_surface(predicted: Float[Tensor, "frames points"], true: Float32[Tensor, "frames points"]) -> Bool[Tensor, " frames"]:
    """Which frames are predicted to lie all on one side of the surface although their true distances lie on both: there is nothing to reconstruct."""
    return _has_both_sides(true) & ~_has_both_sides(predicted)


def _has_both_sides(distances: Tensor) -> Tensor:
    is_inside = distances < 0
    return is_inside.any(dim=1) & ~is_inside.all(dim=1)


def _reason(networks: Networks, batch: Batch) -> str:
    for what, values in (("shapes", batch.shapes), ("distances", batch.distances)):
        bad = ~values.flatten(1).isfinite().all(dim=1)
        if bad.any():
            return f"the {what} of frames {batch.frames[bad.cpu()].tolist()} are not finite; delete the prepared files and they are made again"
    if not batch.points.isfinite().all():
        return "the query points are not finite; delete the prepared files and they are made again"
    layer = first_layer_without_finite_output(networks, batch)
    if layer is None:
        return f"every layer's output is finite, but too large for the loss; {LOWER_RATES}"
    weights = [name for name, values in networks.get_submodule(layer).named_parameters() if not values.isfinite().all()]
    of_these = f", whose {' and '.join(weights)} is not finite either" if weights else ""
    return f"the first layer whose output is not finite is {layer}{of_these}; {LOWER_RATES}"
