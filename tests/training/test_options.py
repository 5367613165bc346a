"""Trainings with the networks and losses that are not the default: each learns, and goes on exactly where it stopped."""

import math
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.optim import Adam

from sdfnet.data.datamodule import ShapeFamily
from sdfnet.errors import ConfigurationError, TrainingError
from sdfnet.models.networks import RECORD, load_networks
from sdfnet.models.settings import ModelSettings
from sdfnet.training.fitting import resolved_precision
from sdfnet.training.losses import eikonal_loss, latent_norm_loss, normal_loss
from sdfnet.training.module import SdfTraining
from sdfnet.training.objective import EIKONAL_STRIDE, Objective
from sdfnet.training.settings import TrainingSettings
from tests.training.short_run import BALL, BOTH, SHARED, SOAP, TURNS, Before, Run, Start

STEPS = 150
GRID = {"grid_levels": 3, "grid_resolution": 2, "grid_table_size": 100}
OPTIONS: dict[str, dict[str, Any]] = {
    "hash grid": {"encoding": "hash_grid", **GRID},
    "dense grid": {"encoding": "dense_grid", **GRID},
    "siren": {"activation": "siren", "omega": 10.0},
    "modulated": {"conditioning": "modulated"},
    "pod": {"latents": "pod"},
    "learned": {"latents": "learned"},
    "all at once": {"encoding": "hash_grid", **GRID, "activation": "siren", "conditioning": "modulated", "latents": "learned"},
}


@pytest.fixture
def run_of(start: Start, folder: Path) -> Callable[..., Run]:
    """A run with a network of its own."""

    def made(model: dict[str, Any], training: TrainingSettings, seed: int = 0, **trainer: Any) -> Run:
        run = start(SHARED, training, SOAP, **trainer)
        torch.manual_seed(seed)
        run.module = SdfTraining(run.family, ModelSettings(width=16, depth=2, latent=3, **model), training, SOAP)
        return run

    return made


def state_of(run: Run) -> list[Any]:
    """All that a run has learned and remembers."""
    return [run.module.networks.state_dict(), [optimizer.state_dict() for optimizer in run.trainer.optimizers]]


def losses_of_steps(run: Run, rate: float) -> list[float]:
    """The loss of each of some steps of Adam in bf16, taken without Lightning."""
    run.family.setup("fit")
    run.module.configure_model()
    networks, objective, losses = run.module.networks, run.module._objective, []
    optimizer = Adam(networks.parameters(), lr=rate)
    for step in range(STEPS):
        batch = run.family.step(0, step, objective.normals_per_shape)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            loss = objective.of_step(networks, networks.encoder(batch.shapes), batch, 0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return losses


@pytest.mark.parametrize("name", OPTIONS)
def test_steps_with_the_eikonal_term_in_bf16_lower_the_loss(run_of: Callable[..., Run], name: str) -> None:
    run = run_of(OPTIONS[name], TrainingSettings(cycle=BOTH, power=1, focus=0.05, latent_weight=0.0, eikonal_weight=0.1))
    losses = losses_of_steps(run, 0.003 if "activation" in OPTIONS[name] else 0.01)  # a phase is omega times as sensitive as a weight
    assert statistics.fmean(losses[-20:]) < 0.75 * statistics.fmean(losses[:20])


@pytest.mark.parametrize("name", OPTIONS)
def test_a_run_goes_on_bit_for_bit_and_its_networks_are_read_back(
    run_of: Callable[..., Run], equal: Callable[[Any, Any], bool], name: str, tmp_path: Path
) -> None:
    training = TrainingSettings(epochs=3, cycle=BOTH, power=1, focus=0.05, eikonal_weight=0.1, normal_weight=0.1)
    at = Before(lambda module, epoch, step: module.trainer.save_checkpoint(tmp_path / "latest.ckpt") if (epoch, step) == (1, 2) else None)
    whole = run_of(OPTIONS[name], training, callbacks=[at]).fit()
    whole.trainer.save_checkpoint(tmp_path / "last.ckpt")
    resumed = run_of(OPTIONS[name], training, seed=99)
    resumed.trainer.fit(resumed.module, datamodule=resumed.family, ckpt_path=tmp_path / "latest.ckpt", weights_only=True)
    assert equal(state_of(resumed), state_of(whole))
    points = torch.rand(9, 3) * 0.1
    found = load_networks(tmp_path / "last.ckpt")(whole.family.shapes, points)
    assert torch.equal(found, whole.module.networks(whole.family.shapes, points))


def test_modes_stay_as_they_are_and_their_latents_are_computed_once_a_phase(run_of: Callable[..., Run]) -> None:
    run, calls = run_of({"latents": "pod"}, TrainingSettings(epochs=2, cycle=BOTH)), []
    run.family.setup("fit")
    run.module.configure_model()
    encoder = run.module.networks.encoder
    before = {name: values.clone() for name, values in encoder.state_dict().items()}
    encoder.register_forward_hook(lambda *_: calls.append(1))
    run.fit()
    assert all(torch.equal(values, before[name]) for name, values in encoder.state_dict().items())
    assert len(calls) == 2  # every epoch of BOTH is a phase
    assert [reading["phase/encoder_trains"] for reading in run.readings.of_epoch.values()] == [0, 0]


def test_a_phase_in_which_modes_would_train_alone_is_refused(run_of: Callable[..., Run]) -> None:
    with pytest.raises(ConfigurationError, match=r"model.latents=pod trains no encoder, found a phase of training.cycle that trains only it; set training"):
        run_of({"latents": "pod"}, TrainingSettings(cycle=TURNS))


def test_latents_of_frames_that_are_not_trained_on_are_learned_by_nobody(folder: Path) -> None:
    family = ShapeFamily(BALL, folder, SHARED, split="interpolation")
    family.setup("fit")
    module = SdfTraining(family, ModelSettings(width=8, latent=3, latents="learned"), TrainingSettings(cycle=BOTH), SOAP)
    with pytest.raises(ConfigurationError, match=r"model.latents=learned has no latent for a frame that is not trained on; set split=all, or model.latents="):
        module.configure_model()


@pytest.mark.parametrize("latents", ["encoder", "learned"])
def test_the_loss_of_a_step_is_the_sum_of_its_terms_with_their_weights(run_of: Callable[..., Run], latents: str) -> None:
    training = TrainingSettings(epochs=1, cycle=BOTH, power=1, latent_weight=0.0, eikonal_weight=0.3, normal_weight=0.2, latent_norm_weight=0.7)
    module = run_of({"latents": latents, "activation": "silu"}, training).fit().module
    objective, networks = Objective(training, 0.2), module.networks
    batch = module._family.step(0, 0, objective.normals_per_shape)
    assert batch.facing is not None
    vectors = networks.encoder(batch.shapes)
    slopes = networks.decoder.gradients(vectors, batch.points[::EIKONAL_STRIDE])
    expected = objective.of_distances(networks.decoder(vectors, batch.points), batch.distances) + 0.3 * eikonal_loss(slopes)
    expected = expected + 0.2 * normal_loss(networks.decoder.gradients(vectors, batch.facing.vertices), batch.facing.normals)
    expected = expected + (0.7 * latent_norm_loss(vectors) if latents == "learned" else 0)
    assert float(objective.of_step(networks, vectors, batch, 0).detach()) == pytest.approx(float(expected.detach()), rel=1e-6)


def test_the_eikonal_term_brings_the_gradients_to_one(run_of: Callable[..., Run]) -> None:
    errors = []
    for weight in (0.0, 100.0):
        run = run_of({"activation": "silu"}, TrainingSettings(cycle=BOTH, power=1, focus=0.05, latent_weight=0.0, eikonal_weight=weight))
        losses_of_steps(run, 0.01)
        networks, points = run.module.networks, run.family.validation.points
        errors.append(float(eikonal_loss(networks.decoder.gradients(networks.latents(run.family.shapes), points)).detach()))
    assert errors[1] < 0.1 * errors[0]


def test_the_normal_term_turns_the_gradients_to_the_normals(run_of: Callable[..., Run]) -> None:
    errors = []
    for weight in (0.0, 30.0):
        run = run_of({"activation": "silu"}, TrainingSettings(cycle=BOTH, power=1, focus=0.05, latent_weight=0.0, normal_weight=weight))
        losses_of_steps(run, 0.01)
        networks, unseen = run.module.networks, run.family.step(STEPS, 0, 500).facing
        assert unseen is not None
        latents = networks.latents(run.family.shapes)[run.family.step(STEPS, 0).frames]
        errors.append(float(normal_loss(networks.decoder.gradients(latents, unseen.vertices), unseen.normals).detach()))
    assert errors[1] < 0.6 * errors[0]


def test_a_checkpoint_from_before_a_setting_existed_is_resumed_where_the_setting_has_its_default(run_of: Callable[..., Run], tmp_path: Path) -> None:
    training = TrainingSettings(epochs=2, cycle=BOTH)
    run = run_of({}, training).fit()
    run.trainer.save_checkpoint(tmp_path / "new.ckpt")
    contents = torch.load(tmp_path / "new.ckpt", weights_only=True)
    for group, later in (("model", "conditioning"), ("training", "eikonal_weight")):
        del contents[RECORD][group][later]
    torch.save(contents, tmp_path / "old.ckpt")
    load_networks(tmp_path / "old.ckpt")
    contents = torch.load(tmp_path / "old.ckpt", weights_only=True)
    same, other = run_of({}, training).module, run_of({"conditioning": "modulated"}, training).module
    for module in (same, other):
        module.trainer = run.trainer
    same.on_load_checkpoint(contents)
    with pytest.raises(TrainingError, match=r"differs from this run in model.conditioning \('first_layer' there, 'modulated' here\)"):
        other.on_load_checkpoint(contents)


def test_terms_are_worth_what_their_formulas_say() -> None:
    slopes = torch.tensor([[[3.0, 0.0, 4.0], [0.0, 0.0, 0.5]], [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]], requires_grad=True)
    loss = eikonal_loss(slopes)
    assert float(loss.detach()) == pytest.approx((4 + 0.5 + 0 + 1) / 4, rel=1e-6)
    loss.backward()
    assert slopes.grad is not None
    assert slopes.grad.isfinite().all()
    assert float(latent_norm_loss(torch.tensor([[3.0, 4.0], [0.0, 1.0]]))) == pytest.approx(13, rel=1e-6)


@pytest.mark.parametrize("name", ["eikonal_weight", "normal_weight", "latent_norm_weight"])
def test_a_negative_weight_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match=f"training.{name} must be finite and not negative, found -1"):
        TrainingSettings(**{name: -1.0})  # type: ignore[arg-type]
    assert math.isfinite(getattr(TrainingSettings(), name))


@pytest.mark.parametrize(
    ("accelerator", "has_cuda", "has_tiles", "quickest"),
    [
        ("cpu", False, False, "32-true"),
        ("cpu", False, True, "bf16-mixed"),
        ("cpu", True, False, "32-true"),
        ("auto", True, False, "bf16-mixed"),
        ("auto", False, False, "32-true"),
    ],
)
def test_quickest_precision_is_that_of_the_device_that_trains(
    monkeypatch: pytest.MonkeyPatch, accelerator: str, has_cuda: bool, has_tiles: bool, quickest: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_cuda)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": has_tiles})
    assert resolved_precision("auto", accelerator) == quickest
    assert resolved_precision("bf16-true", accelerator) == "bf16-true", "what was asked for"
