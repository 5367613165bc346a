"""In which order the shapes are seen (paper section 4, Training Procedure). Pure functions of seed, epoch and step."""

import numpy as np
from jaxtyping import Int64


def pass_order(frames: int, epoch: int, pass_index: int, ordered_epochs: int, seed: int) -> Int64[np.ndarray, " frames"]:
    """The order of one pass over the frames: up, then down, in turn for the first `ordered_epochs` epochs (from 0), shuffled after."""
    if epoch >= ordered_epochs:
        return np.random.default_rng([seed, 1, epoch, pass_index]).permutation(frames)
    up = np.arange(frames, dtype=np.int64)
    return up if (epoch + pass_index) % 2 == 0 else up[::-1].copy()


def frames_of_step(frames: int, epoch: int, step: int, per_step: int, stride: int, ordered_epochs: int, seed: int) -> Int64[np.ndarray, " chosen"]:
    """The frames of one training step: `per_step` neighbours in the pass's order, starting `stride` further each step.

    The paper's pairs are per_step 2 and stride 1: each shape with the one that follows it.
    """
    steps_per_pass = -(-frames // stride)
    pass_index, within = divmod(step, steps_per_pass)
    order = pass_order(frames, epoch, pass_index, ordered_epochs, seed)
    return order[(within * stride + np.arange(per_step)) % frames]
