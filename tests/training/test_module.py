"""How the LightningModule wires networks, cycle, schedules and losses, seen through short runs."""

import copy
import statistics
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger
from torch import Tensor

from sdfnet.data.datamodule import BatchSettings, ShapeFamily
from sdfnet.data.prepare import prepare
from sdfnet.errors import TrainingError
from sdfnet.geometry.solids import Sphere
from sdfnet.models.networks import RECORD, load_networks
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.scene import Dataset, Effect, Recording, Sampling, Scene
from sdfnet.training import module as module_file
from sdfnet.training.cycle import Phase
from sdfnet.training.losses import alpha_latent, latent_loss
from sdfnet.training.module import SdfTraining
from sdfnet.training.schedules import Plateau, decay
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),  # steps are numbers, there is nothing for a worker to do
    pytest.mark.filterwarnings("ignore:.*LeafSpec"),  # inside Lightning 2.6
]

FRAMES = 5
EFFECTS: dict[str, Effect] = {side: PressurePoke(center=(x, 0.0, 0.0), radius=0.03, pressure=3000.0) for side, x in (("left", -0.05), ("right", 0.05))}
BALL = Dataset(Scene(Sphere(cells=4), EFFECTS, recording=Recording(duration=0.002, frames=FRAMES)), Sampling(count=1500, near_surface_count=800))
MODEL = ModelSettings(width=8, depth=2, latent=4)
PAIRS = BatchSettings(validation_points=100)
SHARED = BatchSettings(frames_per_step=3, stride=3, points_per_step=100, near_share=0.5, steps_per_epoch=4, ordered_epochs=0, validation_points=100)
BOTH = (Phase("both", 1),)
TURNS = (Phase("both", 2), Phase("encoder", 2), Phase("decoder", 3))
SOAP = OptimizerSettings("soap", 0.002, 0.003, "cosine", 0.1)


class Readings(Logger):
    """Keeps what is logged, by epoch."""

    def __init__(self) -> None:
        super().__init__()
        self.of_epoch: dict[int, dict[str, float]] = {}

    @property
    def name(self) -> str:
        return "readings"

    @property
    def version(self) -> int:
        return 0

    def log_hyperparams(self, *arguments: Any, **named: Any) -> None:
        """There is nothing to keep."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        assert step is not None
        self.of_epoch[step] = dict(metrics)


class Before(Callback):
    """Calls a function before every step."""

    def __init__(self, call: Callable[[SdfTraining, int, int], None]) -> None:
        self._call = call

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        assert isinstance(pl_module, SdfTraining)
        self._call(pl_module, trainer.current_epoch, batch_idx)


class Run:
    """A short training on the ball, with what came of it."""

    def __init__(self, folder: Path, batch: BatchSettings, training: TrainingSettings, optimizer: OptimizerSettings, **trainer: Any) -> None:
        torch.manual_seed(0)
        self.family = ShapeFamily(BALL, folder, batch)
        self.module = SdfTraining(self.family, MODEL, training, optimizer)
        self.readings = Readings()
        settings: dict[str, Any] = {
            "accelerator": "cpu",
            "max_epochs": training.epochs,
            "check_val_every_n_epoch": training.validate_every,
            "num_sanity_val_steps": 0,
            "logger": self.readings,
            "log_every_n_steps": 1,
            "enable_checkpointing": False,
            "enable_progress_bar": False,
            "enable_model_summary": False,
        }
        self.trainer = Trainer(**settings | trainer)

    def fit(self) -> "Run":
        self.trainer.fit(self.module, datamodule=self.family)
        return self


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("data")
    prepare(BALL, made)
    return made


def first_weights(folder: Path) -> SdfTraining:
    """A module with the weights that every run begins with."""
    run = Run(folder, PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings())
    run.family.setup("fit")
    run.module.configure_model()
    return run.module


def test_the_papers_two_plateaus_on_two_networks_are_four_schedulers(folder: Path) -> None:
    run = Run(folder, PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings()).fit()
    schedulers = [configured.scheduler for configured in run.trainer.lr_scheduler_configs]
    assert len({id(scheduler) for scheduler in schedulers}) == 4
    encoder, decoder = run.trainer.optimizers
    assert [scheduler.optimizer for scheduler in schedulers] == [encoder, decoder, encoder, decoder]
    assert [(scheduler.patience, scheduler.factor) for scheduler in schedulers] == [(30, 0.92)] * 2 + [(2, 0.75)] * 2  # type: ignore[attr-defined]
    assert [group["lr"] for optimizer in (encoder, decoder) for group in optimizer.param_groups] == [0.0075, 0.005]


def test_each_network_has_an_optimizer_of_its_own(folder: Path) -> None:
    run = Run(folder, SHARED, TrainingSettings(epochs=1, cycle=BOTH), SOAP).fit()
    for optimizer, network in zip(run.trainer.optimizers, (run.module.networks.encoder, run.module.networks.decoder), strict=True):
        assert [id(weights) for group in optimizer.param_groups for weights in group["params"]] == [id(weights) for weights in network.parameters()]


def test_plateaus_listen_in_their_epochs_only_and_each_to_its_own_loss(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []
    monkeypatch.setattr(module_file, "take_reading", lambda scheduler, value, what: heard.append(f"{scheduler.patience} {what}"))
    plateaus = (Plateau(2, 3, "batch", 30, 0.92), Plateau(4, None, "validation", 2, 0.75))
    Run(folder, PAIRS, TrainingSettings(epochs=5, cycle=BOTH), OptimizerSettings(plateaus=plateaus), num_sanity_val_steps=1).fit()
    by_batch = [f"30 batch loss of epoch {epoch}" for epoch in (1, 2) for _ in range(2 * FRAMES)]  # paper epochs 2 and 3; two networks
    assert heard == by_batch + [f"2 validation loss of epoch {epoch}" for epoch in (3, 4) for _ in range(2)]


def test_a_plateau_of_zero_patience_cuts_both_rates(folder: Path) -> None:
    plateaus = (Plateau(1, None, "batch", 0, 0.5),)
    # a rate of 1e-12 moves no weight in float32: the pairs of the second epoch repeat those of the first backwards, none is better than the best
    settings = OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12, plateaus=plateaus)
    run = Run(folder, PAIRS, TrainingSettings(epochs=2, cycle=BOTH, latent_weight=0.0), settings).fit()
    first, second = (run.readings.of_epoch[epoch] for epoch in (0, 1))
    assert second["rate/encoder"] == second["rate/decoder"] == pytest.approx(first["rate/encoder"] * 0.5**FRAMES, rel=1e-9)


def test_a_run_without_plateaus_keeps_its_rates(folder: Path) -> None:
    run = Run(folder, PAIRS, TrainingSettings(epochs=2, cycle=BOTH), OptimizerSettings(plateaus=())).fit()
    assert [(reading["rate/encoder"], reading["rate/decoder"]) for reading in run.readings.of_epoch.values()] == [(0.0075, 0.005)] * 2


@pytest.mark.parametrize("schedule", ["linear", "cosine"])
def test_decaying_rates_follow_epoch_and_step(folder: Path, schedule: str) -> None:
    rates: dict[tuple[int, int], list[float]] = {}

    def note(module: SdfTraining, epoch: int, step: int) -> None:
        if step > 0:  # what the step before was taken with
            rates[epoch, step - 1] = [optimizer.param_groups[0]["lr"] for optimizer in module.trainer.optimizers]

    settings = replace(SOAP, schedule=schedule)
    Run(folder, SHARED, TrainingSettings(epochs=3, cycle=BOTH), settings, callbacks=[Before(note)]).fit()
    assert len(rates) == 9
    for (epoch, step), found in rates.items():
        factor = decay(schedule, (4 * epoch + step) / 12, 0.1)
        assert found == pytest.approx([0.002 * factor, 0.003 * factor], rel=1e-12)


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


def equal(first: Any, second: Any) -> bool:
    """Bit-equal, through dictionaries and lists."""
    if isinstance(first, Tensor):
        return torch.equal(first, second)
    if isinstance(first, Mapping):
        return first.keys() == second.keys() and all(equal(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(equal(one, other) for one, other in zip(first, second, strict=True))
    return bool(first == second)


@pytest.mark.parametrize("optimizer", [OptimizerSettings(), SOAP], ids=["adam", "soap"])
def test_a_frozen_network_is_bit_equal_over_its_phase_and_has_no_gradients(folder: Path, optimizer: OptimizerSettings) -> None:
    states: dict[tuple[int, int], dict[str, Any]] = {}
    run = Run(
        folder,
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


def test_the_encoder_runs_once_in_a_phase_that_trains_only_the_decoder(folder: Path) -> None:
    calls: list[int] = []

    def listen(module: SdfTraining, epoch: int, step: int) -> None:
        if (epoch, step) == (0, 0):
            module.networks.encoder.register_forward_hook(lambda *_: calls.append(module.current_epoch))

    Run(folder, SHARED, TrainingSettings(epochs=8, cycle=TURNS), SOAP, callbacks=[Before(listen)]).fit()
    # elsewhere: four steps, the validation, the latents that are logged with it
    assert {epoch: calls.count(epoch) for epoch in range(8)} == {0: 6, 1: 6, 2: 6, 3: 6, 4: 1, 5: 0, 6: 0, 7: 6}


def test_the_latents_of_a_decoder_phase_are_those_of_the_encoder(folder: Path) -> None:
    alone = Run(folder, SHARED, TrainingSettings(epochs=1, cycle=(Phase("decoder", 1),), latent_weight=0.0), SOAP).fit()
    shared = Run(folder, SHARED, TrainingSettings(epochs=1, cycle=BOTH, latent_weight=0.0), OptimizerSettings("soap", 1e-12, 0.003, "cosine", 0.1)).fit()
    # the encoder's rate of 1e-12 moves nothing in float32; all frames at once round differently from three
    for key, value in alone.readings.of_epoch[0].items():
        if key.startswith("loss"):
            assert value == pytest.approx(shared.readings.of_epoch[0][key], rel=1e-4)


def test_the_loss_of_a_pair_is_equation_1(folder: Path) -> None:
    losses: list[float] = []
    module = first_weights(folder)
    family = module._family
    for step in range(FRAMES):
        batch = family.step(0, step)
        latents = module.networks.latents(batch.shapes)
        with torch.no_grad():
            per_shape = (module.networks.decoder(latents, batch.points) - batch.distances).square().mean(dim=1)
        losses.append(float(per_shape.sum() / 2 + alpha_latent(0) * latent_loss(latents, batch.frames)))
    run = Run(folder, PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12)).fit()
    assert run.readings.of_epoch[0]["loss/train_mean"] == pytest.approx(statistics.fmean(losses), rel=1e-5)
    assert run.readings.of_epoch[0]["loss/train_max"] == pytest.approx(max(losses), rel=1e-5)


def test_the_validation_loss_is_the_mean_and_the_largest_over_the_shapes(folder: Path) -> None:
    module = first_weights(folder)
    batch = module._family.validation
    with torch.no_grad():
        per_shape = (module.networks(batch.shapes, batch.points) - batch.distances).square().mean(dim=1)
    run = Run(folder, PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12)).fit()
    reading = run.readings.of_epoch[0]
    assert reading["loss/validation_mean"] == pytest.approx(float(per_shape.mean()), rel=1e-5)
    assert reading["loss/validation_max"] == pytest.approx(float(per_shape.max()), rel=1e-5)
    latents = module.networks.latents(module._family.shapes)
    assert reading["latent/cosine_first_to_last"] == pytest.approx(float(torch.cosine_similarity(latents[0], latents[-1], dim=0)), abs=1e-6)


def test_absolute_errors_are_measured_in_hundredths_of_the_diagonal_and_fade_with_distance(folder: Path) -> None:
    module = first_weights(folder)
    batch, diagonal = module._family.validation, module._family.trajectory.mesh.diagonal
    with torch.no_grad():
        error = (module.networks(batch.shapes, batch.points) - batch.distances).abs() / (diagonal / 100)
    weighed = error / (1 + batch.distances.abs() / (0.02 * diagonal))
    training = TrainingSettings(epochs=1, cycle=BOTH, power=1, focus=0.02)
    run = Run(folder, PAIRS, training, OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12)).fit()
    assert run.readings.of_epoch[0]["loss/validation_mean"] == pytest.approx(float(weighed.mean()), rel=1e-5)


def test_validation_comes_when_it_is_due(folder: Path) -> None:
    run = Run(folder, SHARED, TrainingSettings(epochs=5, cycle=BOTH, validate_every=2), SOAP).fit()
    assert [epoch for epoch, reading in run.readings.of_epoch.items() if "loss/validation_mean" in reading] == [1, 3]
    assert sorted(run.readings.of_epoch) == [0, 1, 2, 3, 4]


def test_a_bad_weight_stops_the_run_with_epoch_step_and_layer(folder: Path) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        if (epoch, step) == (1, 2):
            with torch.no_grad():
                module.networks.decoder.layers.get_parameter("0.weight")[3, 1] = torch.nan

    run = Run(folder, SHARED, TrainingSettings(epochs=3, cycle=BOTH), SOAP, callbacks=[Before(spoil)])
    message = r"epoch 1, step 2: the loss must be finite, found nan; the first layer with a bad weight is decoder.layers.0.weight; lower optimizer.encoder_rate"
    with pytest.raises(TrainingError, match=message):
        run.fit()
    # stopped before the step, so that only the planted number is bad
    assert sum(int((~weights.isfinite()).sum()) for weights in run.module.networks.parameters()) == 1


def test_a_bad_distance_stops_the_run_with_its_frames(folder: Path) -> None:
    def spoil(module: SdfTraining, epoch: int, step: int) -> None:
        module._family._tensors["frame_distances"][3] = torch.inf

    run = Run(folder, PAIRS, TrainingSettings(epochs=3, cycle=BOTH), OptimizerSettings(), callbacks=[Before(spoil)])
    message = r"epoch 0, step 2: the loss must be finite, found inf; the first layer with a bad weight is none; .* bad distances in frames \[2, 3\]"
    with pytest.raises(TrainingError, match=message):
        run.fit()


def plain(value: Any) -> bool:
    """Whether a value is made of tensors, numbers, text and containers only."""
    if isinstance(value, Mapping):
        return all(plain(key) and plain(item) for key, item in value.items())
    if isinstance(value, list | tuple | set):
        return all(plain(item) for item in value)
    return value is None or type(value) in (bool, int, float, str, torch.Tensor)


@pytest.mark.parametrize("optimizer", [OptimizerSettings(), SOAP], ids=["adam", "soap"])
def test_a_checkpoint_holds_only_plain_values_and_says_what_it_is_of(folder: Path, tmp_path: Path, optimizer: OptimizerSettings) -> None:
    run = Run(folder, SHARED, TrainingSettings(epochs=1, cycle=BOTH), optimizer).fit()
    run.trainer.save_checkpoint(tmp_path / "last.ckpt")
    contents = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert plain(contents)
    assert contents[RECORD]["model"] == vars(MODEL)
    assert contents[RECORD]["train_frames"] == list(range(FRAMES))
    assert {(folder / contents[RECORD][what]).is_file() for what in ("trajectory", "distances")} == {True}
    found = load_networks(tmp_path / "last.ckpt")
    points = torch.rand(9, 3) * 0.1
    assert torch.equal(found(run.family.shapes, points), run.module.networks(run.family.shapes, points))


def test_a_module_can_be_fitted_again(folder: Path) -> None:
    training = TrainingSettings(epochs=1, cycle=(Phase("decoder", 1),))
    first, second = Run(folder, SHARED, training, SOAP).fit(), Run(folder, SHARED, training, SOAP)
    with torch.no_grad():
        first.module.networks.encoder.layers.get_parameter("0.weight").mul_(2)
    second.module = first.module
    calls: list[int] = []
    first.module.networks.encoder.register_forward_hook(lambda *_: calls.append(1))
    second.fit()
    assert sum(calls) == 1  # latents are those of the encoder as it is now


def test_bf16_keeps_weights_and_losses_finite_and_float32(folder: Path) -> None:
    run = Run(folder, PAIRS, TrainingSettings(epochs=8, cycle=TURNS), OptimizerSettings(), precision="bf16-mixed").fit()
    assert all(torch.isfinite(torch.tensor(list(reading.values()))).all() for reading in run.readings.of_epoch.values())
    for weights in run.module.networks.parameters():
        assert weights.dtype == torch.float32
        assert weights.isfinite().all()


def test_training_time_is_noted(folder: Path) -> None:
    assert Run(folder, SHARED, TrainingSettings(epochs=1, cycle=BOTH), SOAP).fit().module.train_seconds > 0
