"""A trained network in fewer bytes."""

import copy

import torch

from sdfnet.errors import ConfigurationError
from sdfnet.models.networks import Networks
from sdfnet.models.storage import STORAGES, as_stored


@torch.no_grad()
def quantised(networks: Networks, storage: str) -> Networks:
    """A copy that answers as if it had been written as `storage` and read back; its `sizes()` are those bytes.

    `fp16` rounds all that is trained in the decoder, and the latents. `int8` gives each feature of the point, each output
    of the other layers, all learned grids together and each shape's latent a scale of their own, and leaves the biases in
    float32. The fixed frequencies always stay in float32: they multiply coordinates, and a phase must be right to a
    thousandth. Only the numbers are rounded; computing is in float32 as before and as fast. Raises ConfigurationError for
    an unknown storage or networks that are quantised already.
    """
    if storage not in STORAGES:
        raise ConfigurationError(f"the storage must be one of {', '.join(STORAGES)}; found '{storage}'")
    if networks.storage != "float32":
        raise ConfigurationError(f"networks to be quantised must be in float32, found {networks.storage}; quantise those of the checkpoint")
    copied = copy.deepcopy(networks)
    copied.storage = storage
    for rows, kept_as in copied.decoder.stored_rows(storage):
        rows.copy_(as_stored(rows, kept_as))
    return copied
