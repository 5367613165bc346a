"""Which network trains in which epoch (paper section 4, Cyclic Training Strategy)."""

from dataclasses import dataclass

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError

TRAINS = ("both", "encoder", "decoder")


@dataclass(frozen=True)
class Phase(Checked):
    """A stretch of epochs in which one network, or both, train: L(n) = max(1, epochs + growth n), n the phase's earlier occurrences."""

    trains: str  # both, encoder or decoder
    epochs: int  # its length when it first occurs
    growth: int = 0  # epochs added each time that it occurs again; negative shortens it

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.trains not in TRAINS:
            raise ConfigurationError(f"a phase trains one of {', '.join(TRAINS)}; found '{self.trains}'")
        if self.epochs < 1:
            raise ConfigurationError(f"a phase lasts at least 1 epoch, found {self.epochs}")

    def length(self, occurrence: int) -> int:
        """Epochs of the phase at its `occurrence`-th time, from 0."""
        return max(1, self.epochs + self.growth * occurrence)


PAPER_CYCLE = (Phase("both", 7), Phase("encoder", 5), Phase("decoder", 12))


@dataclass(frozen=True)
class PhaseAt:
    """Where an epoch stands: which networks train, since which epoch, and how many phases came before."""

    trains: str
    first_epoch: int
    index: int

    @property
    def trains_encoder(self) -> bool:
        """Whether the Mesh Encoder's weights move."""
        return self.trains in ("both", "encoder")

    @property
    def trains_decoder(self) -> bool:
        """Whether the SDF Calculator's weights move."""
        return self.trains in ("both", "decoder")


def phase_at(cycle: tuple[Phase, ...], epoch: int) -> PhaseAt:
    """The phase of an epoch (from 0): the phases follow each other in order, again and again. Raises ConfigurationError for an empty cycle."""
    if not cycle:
        raise ConfigurationError("a cycle needs at least one phase; for no freezing use one that trains both")
    first_epoch, index = 0, 0
    while True:
        phase = cycle[index % len(cycle)]
        length = phase.length(index // len(cycle))
        if epoch < first_epoch + length:
            return PhaseAt(phase.trains, first_epoch, index)
        first_epoch, index = first_epoch + length, index + 1
