"""Learned features on grids over the box, interpolated at a point: dense, or hashed at several resolutions."""

import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor, nn

HASH_PRIMES = (1, 2_654_435_761, 805_459_861)  # Mueller et al. 2022, equation 4
LARGEST_FIRST_FEATURE = 1e-4  # section 4 there: features begin uniform between minus and plus this


class GridFeatures(nn.Module):
    """Multiresolution hash encoding (Mueller et al. 2022), or one dense grid where every point has a row of its own.

    Each level divides the box into N^3 cells, looks up the features of the eight corners of a point's cell and
    interpolates them trilinearly. Corner (x, y, z) has row (x + y p_2 + z p_3, with xor for plus) mod T of its level's
    table; a level with no more than T corners needs no hash, and each has its own. A point outside the box has the
    features of the nearest point of it. Not for a network that must be smooth: the gradient jumps from cell to cell.
    """

    extent: Tensor
    resolutions: Tensor
    rows: Tensor
    first_rows: Tensor
    corners: Tensor
    primes: Tensor

    def __init__(self, resolutions: list[int], features: int, table_size: int, extent: Float32[Tensor, "3"]) -> None:
        """`extent` is the box's half sides, in the unit of the points."""
        super().__init__()
        self.features = len(resolutions) * features
        rows = [min((resolution + 1) ** 3, table_size) for resolution in resolutions]
        # Flat, because SOAP preconditions every matrix by Gram matrices of its rows, and these are thousands.
        self.table = nn.Parameter(torch.empty(sum(rows) * features).uniform_(-LARGEST_FIRST_FEATURE, LARGEST_FIRST_FEATURE))
        self.register_buffer("extent", extent)
        constants = {"resolutions": resolutions, "rows": rows, "first_rows": [sum(rows[:level]) for level in range(len(rows))], "primes": HASH_PRIMES}
        for name, values in constants.items():
            self.register_buffer(name, torch.tensor(values), persistent=False)
        self.register_buffer("corners", torch.cartesian_prod(*[torch.arange(2)] * 3), persistent=False)

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch features"]:
        """Features of points counted from the box's centre, level after level."""
        in_box = ((points / self.extent + 1) / 2).clamp(0, 1)
        cells = in_box[..., None, :] * self.resolutions[:, None]
        # A point that is not finite has an output that is not, which is reported; its row must exist all the same.
        first = torch.minimum(cells.detach().nan_to_num().floor().long(), self.resolutions[:, None] - 1)
        beyond = (cells - first)[..., None, :]
        weights = torch.where(self.corners == 1, beyond, 1 - beyond).prod(dim=-1)
        rows = self._rows(first[..., None, :] + self.corners)
        table = self.table.unflatten(0, (-1, self.features // len(self.rows)))
        features = table.index_select(0, rows.flatten()).unflatten(0, rows.shape)  # three times as fast as an embedding
        return (weights[..., None] * features).sum(dim=-2).flatten(-2)

    def _rows(self, corners: Int64[Tensor, "*batch levels 8 3"]) -> Int64[Tensor, "*batch levels 8"]:
        x, y, z = (corners * self.primes).unbind(dim=-1)
        side = self.resolutions[:, None] + 1
        own = (corners[..., 0] * side + corners[..., 1]) * side + corners[..., 2]
        return self.first_rows[:, None] + torch.where(side**3 <= self.rows[:, None], own, (x ^ y ^ z) % self.rows[:, None])
