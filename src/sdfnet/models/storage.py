"""How many bytes a number of a trained network is stored in, and what it is after that."""

import torch
from jaxtyping import Float
from torch import Tensor

from sdfnet.errors import TrainingError

STORAGES = ("float32", "fp16", "int8")
INT8_LARGEST = 127  # symmetric: -127 to 127
SCALE_BYTES = 4  # of a row of int8


def as_stored(rows: Float[Tensor, "rows columns"], storage: str) -> Float[Tensor, "rows columns"]:
    """Numbers as they are read back: fp16 rounds to 11 bits, int8 to a 127th of the largest of its row.

    An int8 number is wrong by at most half of that step. Raises TrainingError for a number beyond fp16.
    """
    if storage == "float32":
        return rows
    if storage == "fp16":
        largest, limit = float(rows.abs().max()), torch.finfo(torch.float16).max
        if not largest <= limit:
            raise TrainingError(f"fp16 holds numbers up to {limit:g}, found {largest:g}; store the networks as int8 or float32")
        return rows.half().to(rows.dtype)
    step = rows.abs().amax(dim=1, keepdim=True) / INT8_LARGEST
    step = torch.where(step > 0, step, torch.ones_like(step))
    return torch.round(rows / step) * step


def stored_bytes(rows: int, columns: int, storage: str) -> int:
    """Bytes of a table of numbers; int8 has a float32 scale a row."""
    numbers = rows * columns
    return {"float32": 4 * numbers, "fp16": 2 * numbers, "int8": numbers + SCALE_BYTES * rows}[storage]
