"""What stops a training, and whether the message leads to the cause: epoch, step, frames, layer."""

import logging
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sdfnet.errors import TrainingError
from sdfnet.training import module as module_file
from sdfnet.training.divergence import loses_surface
from sdfnet.training.module import SdfTraining
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from tests.training.short_run import BOTH, FRAMES, PAIRS, SHARED, SOAP, Before, Run, Start

STILL = OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12)  # moves no weight in float32
LAYERS = ("encoder.layers.0", "encoder.layers.4", "decoder.from_latent", "decoder.from_point", "decoder.layers.0", "decoder.layers.2")


def bad_numbers(run: Run) -> int:
    return sum(int((~weights.isfinite()).sum()) for weights in run.module.networks.parameters())


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("layer", LAYERS)
def test_a_bad_weight_stops_the_run_with_epoch_step_and_layer(start: Start, layer: str, precision: str) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        if (epoch, step) == (1, 2):
            with torch.no_grad():
                module.networks.get_parameter(f"{layer}.weight")[0, 1] = torch.nan

    run = start(SHARED, TrainingSettings(epochs=3, cycle=BOTH), SOAP, callbacks=[Before(spoil)], precision=precision)
    message = rf"epoch 1, step 2: the loss must be finite, found nan on frames \[\d, \d, \d\]; the first layer whose output is not finite is {layer}, "
    with pytest.raises(TrainingError, match=message + "whose weight is not finite either; lower optimizer.encoder_rate"):
        run.fit()
    assert bad_numbers(run) == 1  # stopped before the step, so that only the planted number is bad


def test_a_layer_that_overflows_by_itself_is_named_without_a_bad_weight(start: Start) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        module.networks.decoder.activation.register_forward_hook(lambda _layer, _inputs, output: output * torch.inf)

    run = start(PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings(), callbacks=[Before(spoil)])
    with pytest.raises(TrainingError, match=r"epoch 0, step 0: .* the first layer whose output is not finite is decoder.activation; lower optimizer"):
        run.fit()


def test_outputs_too_large_for_the_loss_are_told_from_bad_ones(start: Start) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        nn.init.constant_(module.networks.get_parameter("decoder.layers.2.bias"), 1e30)  # finite, its square is not

    run = start(PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings(), callbacks=[Before(spoil)])
    with pytest.raises(TrainingError, match="found inf on frames .*; every layer's output is finite, but too large for the loss; lower optimizer.encoder_rate"):
        run.fit()


def test_a_bad_gradient_stops_the_run_before_the_step_that_it_would_spoil(start: Start) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        def listen(layer: nn.Module, inputs: Any, output: Tensor) -> None:
            if output.requires_grad:
                output.register_hook(lambda gradient: gradient * torch.nan)

        if (epoch, step) == (1, 2):
            module.networks.decoder.activation.register_forward_hook(listen)

    run = start(SHARED, TrainingSettings(epochs=3, cycle=BOTH), SOAP, callbacks=[Before(spoil)])
    message = r"epoch 1, step 2: gradients must be finite on frames \[\d, \d, \d\]; on the way back from the loss the first layer where one is not is "
    with pytest.raises(TrainingError, match=message + "decoder.from_latent; lower optimizer.encoder_rate"):
        run.fit()
    assert bad_numbers(run) == 0


@pytest.mark.parametrize(("what", "tensor"), [("distances", "frame_distances"), ("shapes", "shapes")])
def test_bad_data_stop_the_run_with_their_frame(start: Start, what: str, tensor: str) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        module._family._tensors[tensor][3] = torch.inf

    run = start(PAIRS, TrainingSettings(epochs=3, cycle=BOTH), OptimizerSettings(), callbacks=[Before(spoil)])
    message = rf"epoch 0, step 2: the loss must be finite, found (inf|nan) on frames \[2, 3\]; the {what} of frames \[3\] are not finite; delete the prepared"
    with pytest.raises(TrainingError, match=message):
        run.fit()


def test_bad_points_stop_the_run_by_name(start: Start) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        module._family._tensors["box_points"][:] = torch.nan

    run = start(PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings(), callbacks=[Before(spoil)])
    with pytest.raises(TrainingError, match="epoch 0, step 0: .*; the query points are not finite; delete the prepared files"):
        run.fit()


def test_a_bad_validation_loss_stops_the_run_with_its_frame_under_any_schedule(start: Start) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        module._family._tensors["validation_distances"][5, 2] = torch.nan

    for optimizer in (OptimizerSettings(), SOAP):
        run = start(SHARED, TrainingSettings(epochs=2, cycle=BOTH), optimizer, callbacks=[Before(spoil)])
        with pytest.raises(TrainingError, match=r"epoch 0: the validation loss must be finite, found it is not for frames \[2\]; lower .* bad distances there"):
            run.fit()


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("latent", [0.0, 1.0], ids=["zero", "equal"])
def test_a_run_that_begins_with_equal_latents_stays_finite(start: Start, latent: float, precision: str) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        if (epoch, step) == (0, 0):
            nn.init.zeros_(module.networks.get_parameter("encoder.layers.4.weight"))
            nn.init.constant_(module.networks.get_parameter("encoder.layers.4.bias"), latent)
            assert (module.networks.latents(module._family.shapes) == latent).all()

    run = start(PAIRS, TrainingSettings(epochs=2, cycle=BOTH), OptimizerSettings(), callbacks=[Before(spoil)], precision=precision).fit()
    assert bad_numbers(run) == 0
    assert len(run.readings.of_epoch) == 2
    assert all(torch.tensor(list(reading.values())).isfinite().all() for reading in run.readings.of_epoch.values())
    latents = run.module.networks.latents(run.family.shapes)
    assert not (latents == latents[0]).all()  # they come apart


def test_a_network_loses_the_surface_where_its_distances_have_one_sign_and_the_true_ones_both() -> None:
    both, above, below = torch.tensor([-1.0, 2.0, 1.0]), torch.tensor([0.0, 2.0, 1.0]), torch.tensor([-1.0, -2.0, -0.1])
    predicted, true = torch.stack([both, above, below, above, below]), torch.stack([both, both, both, above, above])
    assert loses_surface(predicted, true).tolist() == [False, True, True, False, False]


def test_a_network_of_one_sign_is_said_at_the_end_of_training(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        nn.init.constant_(module.networks.get_parameter("decoder.layers.2.bias"), 100.0)  # far outside everywhere

    run = start(SHARED, TrainingSettings(epochs=1, cycle=BOTH), STILL, callbacks=[Before(spoil)]).fit()
    assert run.readings.of_epoch[0]["validation/frames_without_surface"] == FRAMES
    assert "the network had no surface in frames [0, 1, 2, 3, 4] when it was last validated: there its distances have one sign; train longer" in caplog.messages


def test_only_frames_without_a_surface_are_named_and_none_in_silence(start: Start, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        monkeypatch.setattr(module_file, "loses_surface", lambda predicted, true: torch.zeros(len(true), dtype=torch.bool))
        start(SHARED, TrainingSettings(epochs=1, cycle=BOTH), STILL).fit()
        assert not any("no surface" in message for message in caplog.messages)
        monkeypatch.setattr(module_file, "loses_surface", lambda predicted, true: torch.arange(len(true)) == 3)  # of the first four frames the last
        start(SHARED, TrainingSettings(epochs=1, cycle=BOTH), STILL).fit()
        assert any("no surface in frames [3]" in message for message in caplog.messages)
