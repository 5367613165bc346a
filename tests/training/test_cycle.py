"""Which network trains in which epoch."""

import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.training.cycle import PAPER_CYCLE, Phase, phase_at


def turns(cycle: tuple[Phase, ...], epochs: int) -> str:
    """One letter an epoch: b both, e encoder, d decoder."""
    return "".join(phase_at(cycle, epoch).trains[0] for epoch in range(epochs))


def test_the_papers_cycle_is_seven_both_five_encoder_twelve_decoder_again_and_again() -> None:
    assert turns(PAPER_CYCLE, 60) == ("b" * 7 + "e" * 5 + "d" * 12) * 2 + "b" * 7 + "e" * 5


def test_any_fixed_order_is_followed() -> None:
    assert turns((Phase("decoder", 2), Phase("both", 1), Phase("decoder", 1), Phase("encoder", 3)), 14) == "ddbdeeeddbdeee"


def test_a_length_may_depend_on_how_often_the_phase_has_occurred() -> None:
    assert turns((Phase("both", 1, growth=2), Phase("decoder", 3, growth=-1)), 21) == "bddd" + "bbbdd" + "bbbbbd" + "b" * 6


def test_a_phase_that_shrinks_keeps_one_epoch() -> None:
    assert [Phase("both", 3, growth=-2).length(occurrence) for occurrence in range(4)] == [3, 1, 1, 1]


def test_an_epoch_knows_its_phases_first_epoch_and_number() -> None:
    for first, last, index in ((0, 6, 0), (7, 11, 1), (12, 23, 2), (24, 30, 3)):
        for epoch in (first, last):
            phase = phase_at(PAPER_CYCLE, epoch)
            assert (phase.first_epoch, phase.index) == (first, index)


@pytest.mark.parametrize(("trains", "encoder", "decoder"), [("both", True, True), ("encoder", True, False), ("decoder", False, True)])
def test_a_phase_says_whose_weights_move(trains: str, encoder: bool, decoder: bool) -> None:
    phase = phase_at((Phase(trains, 1),), 5)
    assert (phase.trains_encoder, phase.trains_decoder) == (encoder, decoder)


def test_what_is_no_phase_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="a phase trains one of both, encoder, decoder; found 'none'"):
        Phase("none", 1)
    with pytest.raises(ConfigurationError, match="lasts at least 1 epoch, found 0"):
        Phase("both", 0)
    with pytest.raises(ConfigurationError, match="a cycle needs at least one phase"):
        phase_at((), 0)
