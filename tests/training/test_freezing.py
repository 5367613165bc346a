"""Whose weights move in which phase, and what is computed when the encoder rests."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch

from sdfnet.training.cycle import Phase
from sdfnet.training.module import SdfTraining
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from tests.training.short_run import BOTH, SHARED, SOAP, TURNS, Before, Start


def state_of(module: SdfTraining) -> dict[str, Any]:
    """Weights, gradients and the optimizer's memory of each network, copied."""
    networks = {"encoder": module.networks.encoder, "decoder": module.networks.decoder}
    return {
        name: {
            "weights": {key: values.clone() for key, values in network.state_dict().items()},
            "memory": copy.deepcopy(optimizer.state_dict()["state"]),
            "gradients": [weights.grad for weights in network.parameters()],
        }
        for (name, network), optimizer in zip(networks.items(), module.trainer.optimizers, strict=True)
    }


@pytest.mark.parametrize("optimizer", [OptimizerSettings(), SOAP], ids=["adam", "soap"])
def test_a_frozen_network_is_bit_equal_over_its_phase_and_has_no_gradients(
    start: Start, equal: Callable[[Any, Any], bool], optimizer: OptimizerSettings
) -> None:
    states: dict[tuple[int, int], dict[str, Any]] = {}
    run = start(
        SHARED,
        TrainingSettings(epochs=8, cycle=TURNS, validate_every=100),  # Lightning clears gradients before it validates
        optimizer,
        callbacks=[Before(lambda module, epoch, step: states.update({(epoch, step): state_of(module)}))],
    ).fit()
    # epochs 0-1 both, 2-3 encoder, 4-6 decoder, 7 both
    for frozen, active, epochs in (("decoder", "encoder", (2, 4)), ("encoder", "decoder", (4, 7))):
        begin, end = (states[epoch, 0] for epoch in epochs)
        assert begin[frozen]["memory"]  # there is momentum that could move the weights
        assert equal(begin[frozen]["weights"], end[frozen]["weights"])
        assert equal(begin[frozen]["memory"], end[frozen]["memory"])
        assert not equal(begin[active]["weights"], end[active]["weights"])
        assert not equal(begin[active]["memory"], end[active]["memory"])
        inside = [states[epoch, step] for epoch in range(*epochs) for step in range(1, 4)]
        assert all(gradient is None for state in inside for gradient in state[frozen]["gradients"])
        assert all(gradient is not None for state in inside for gradient in state[active]["gradients"])
    assert not equal(states[0, 0]["encoder"]["weights"], states[2, 0]["encoder"]["weights"])
    assert not equal(states[7, 0]["encoder"]["weights"], state_of(run.module)["encoder"]["weights"])
    assert [reading["phase/encoder_trains"] for reading in run.readings.of_epoch.values()] == [1, 1, 1, 1, 0, 0, 0, 1]
    assert [reading["phase/decoder_trains"] for reading in run.readings.of_epoch.values()] == [1, 1, 0, 0, 1, 1, 1, 1]


def test_the_encoder_runs_once_in_a_phase_that_trains_only_the_decoder(start: Start) -> None:
    calls: list[int] = []

    def listen(module: SdfTraining, epoch: int, step: int) -> None:
        if (epoch, step) == (0, 0):
            module.networks.encoder.register_forward_hook(lambda *_: calls.append(module.current_epoch))

    start(SHARED, TrainingSettings(epochs=8, cycle=TURNS), SOAP, callbacks=[Before(listen)]).fit()
    # elsewhere: four steps, the validation, the latents that are logged with it
    assert {epoch: calls.count(epoch) for epoch in range(8)} == {0: 6, 1: 6, 2: 6, 3: 6, 4: 1, 5: 0, 6: 0, 7: 6}


def test_the_latents_of_a_decoder_phase_are_those_of_the_encoder(start: Start) -> None:
    alone = start(SHARED, TrainingSettings(epochs=1, cycle=(Phase("decoder", 1),), latent_weight=0.0), SOAP).fit()
    shared = start(SHARED, TrainingSettings(epochs=1, cycle=BOTH, latent_weight=0.0), OptimizerSettings("soap", 1e-12, 0.003, "cosine", 0.1)).fit()
    # the encoder's rate of 1e-12 moves nothing in float32; all frames at once round differently from three
    for key, value in alone.readings.of_epoch[0].items():
        if key.startswith("loss"):
            assert value == pytest.approx(shared.readings.of_epoch[0][key], rel=1e-4)


def test_a_module_can_be_fitted_again(start: Start) -> None:
    training = TrainingSettings(epochs=1, cycle=(Phase("decoder", 1),))
    first, second = start(SHARED, training, SOAP).fit(), start(SHARED, training, SOAP)
    with torch.no_grad():
        first.module.networks.encoder.get_parameter("layers.0.weight").mul_(2)
    second.module = first.module
    calls: list[int] = []
    first.module.networks.encoder.register_forward_hook(lambda *_: calls.append(1))
    second.fit()
    assert sum(calls) == 1  # latents are those of the encoder as it is now
