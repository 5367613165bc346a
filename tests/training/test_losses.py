"""The losses of the paper, equations 1 to 9."""

import math

import pytest
import torch
from torch import Tensor

from sdfnet.training.losses import alpha_latent, latent_loss, one_minus_cosine, sdf_loss, time_scale

UNIT = torch.tensor([[0.6, 0.8, 0.0]])


def one_bf16_ulp_up(vector: Tensor) -> Tensor:
    """The first component raised by one step of bf16, which has 8 significant bits."""
    moved = vector.bfloat16()
    moved[:, 0] = torch.nextafter(moved[:, 0], torch.full_like(moved[:, 0], torch.inf))
    return moved.float()


HARD_PAIRS = {
    "equal": (UNIT, UNIT),
    "equal direction, other length": (UNIT, 3 * UNIT),
    "first zero": (0 * UNIT, UNIT),
    "both zero": (0 * UNIT, 0 * UNIT),
    "opposite": (UNIT, -UNIT),
    "one bf16 ulp apart": (UNIT.bfloat16().float(), one_bf16_ulp_up(UNIT)),
    "tiny": (1e-30 * UNIT, -1e-30 * UNIT),
}


def test_the_sdf_loss_is_the_mean_square_of_equation_3_averaged_over_the_pair_of_equation_2() -> None:
    predicted, true = torch.tensor([[1.0, 2.0], [0.0, -1.0]]), torch.tensor([[0.5, 2.0], [3.0, -2.0]])
    first, second = (0.5**2 + 0) / 2, (3**2 + 1) / 2
    assert float(sdf_loss(predicted, true)) == pytest.approx((first + second) / 2, rel=1e-7)


def test_the_absolute_loss_with_focus_weighs_by_the_nearer_of_the_true_and_the_predicted_surface() -> None:
    predicted, true = torch.tensor([[1.0, -2.0]]), torch.tensor([[0.5, -4.0]])
    assert float(sdf_loss(predicted, true, power=1)) == pytest.approx((0.5 + 2) / 2, rel=1e-7)
    assert float(sdf_loss(predicted, true, power=1, focus=2.0)) == pytest.approx((0.5 / 1.25 + 2 / 2) / 2, rel=1e-6)
    assert float(sdf_loss(predicted, true, power=1, unit=0.1)) == pytest.approx(10 * (0.5 + 2) / 2, rel=1e-6)


@pytest.mark.parametrize("true", [4.0, -4.0])
def test_a_false_surface_far_from_the_true_one_counts_in_full(true: float) -> None:
    distances = torch.tensor([[true]])
    wrong_sign = -0.1 * distances
    assert float(sdf_loss(wrong_sign, distances, power=1, focus=0.01)) == pytest.approx(4.4, rel=1e-6)
    zero = 0 * distances
    assert float(sdf_loss(zero, distances, power=1, focus=0.01)) == pytest.approx(4.0, rel=1e-6)


def test_the_weight_of_the_focus_has_no_slope() -> None:
    predicted, true = torch.tensor([[0.5]], requires_grad=True), torch.tensor([[1.0]])
    sdf_loss(predicted, true, power=1, focus=0.5).backward()
    assert predicted.grad is not None
    assert float(predicted.grad) == pytest.approx(-1 / (1 + 0.5 / 0.5))


def test_the_sdf_loss_is_float32_of_bf16_predictions() -> None:
    assert sdf_loss(torch.ones(1, 3).bfloat16(), torch.zeros(1, 3)).dtype == torch.float32


def test_one_minus_cosine_is_that_of_equation_5() -> None:
    first, second = torch.randn(50, 8), torch.randn(50, 8)
    expected = 1 - torch.nn.functional.cosine_similarity(first.double(), second.double())
    torch.testing.assert_close(one_minus_cosine(first, second).double(), expected, rtol=0, atol=1e-6)


def test_one_minus_cosine_is_never_negative_and_exact_near_one() -> None:
    angle = torch.tensor([1e-4, 1e-3, 1e-2], dtype=torch.float64)
    first = torch.tensor([[1.0, 0.0]]).expand(3, 2)
    second = torch.stack([angle.cos(), angle.sin()], dim=1).float()
    # plain 1 - C in float32 would be wrong by 100 % at 1e-4, where 1 - C = 5e-9
    torch.testing.assert_close(one_minus_cosine(first, second).double(), 1 - angle.cos(), rtol=1e-4, atol=0)
    same = torch.randn(1000, 32)
    assert float(one_minus_cosine(same, same).abs().max()) == 0


def test_the_latent_loss_has_hand_computed_values() -> None:
    latents = torch.tensor([[1.0, 0.0], [0.0, 2.0], [-3.0, 0.0]])
    right_angle = 1 / math.sqrt(1e-6 + 1)
    # pairs (0, 1) and (1, 2), both at a right angle, 3 and 96 frames apart: f_td(3) = sqrt(34), f_td(96) = sqrt(9706)
    expected = (right_angle / math.sqrt(34) + right_angle / math.sqrt(9706)) / 2
    assert float(latent_loss(latents, torch.tensor([4, 1, 97]))) == pytest.approx(expected, rel=1e-6)
    opposite = 1 / (math.sqrt(16) * math.sqrt(1e-6 + 2))  # f_td(1) = 4
    assert float(latent_loss(latents[[0, 2]], torch.tensor([7, 8]))) == pytest.approx(opposite, rel=1e-6)
    equal = 1 / (math.sqrt(16) * 1e-3)
    assert float(latent_loss(latents[[0, 0]], torch.tensor([8, 7]))) == pytest.approx(equal, rel=1e-6)


def test_the_time_scale_is_equation_6() -> None:
    t = torch.arange(0, 101)
    torch.testing.assert_close(time_scale(t).double(), torch.sqrt((t * t + 5 * t + 10).double()), rtol=1e-6, atol=0)


def test_latents_of_distant_frames_are_pushed_apart_less() -> None:
    latents = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    losses = [float(latent_loss(latents, torch.tensor([0, apart]))) for apart in (1, 2, 10, 100)]
    assert losses == sorted(losses, reverse=True)


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "autocast"])
@pytest.mark.parametrize("pair", HARD_PAIRS)
def test_hard_pairs_have_a_finite_loss_and_finite_gradients(pair: str, autocast: bool) -> None:
    latents = torch.cat(HARD_PAIRS[pair]).requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
        loss = latent_loss(latents, torch.tensor([3, 4]))
    (gradient,) = torch.autograd.grad(loss, latents)
    assert 0 < float(loss.detach()) <= 1000 / 4 * 1.000001  # 1 / sqrt(1e-6), over f_td(1) = 4
    assert gradient.isfinite().all()


def test_equal_latents_are_at_rest_and_all_others_move_apart() -> None:
    for pair in ("equal", "one bf16 ulp apart"):
        latents = torch.cat(HARD_PAIRS[pair]).requires_grad_()
        (gradient,) = torch.autograd.grad(latent_loss(latents, torch.tensor([3, 4])), latents)
        if pair == "equal":
            assert float(gradient.abs().max()) == 0
        else:
            with torch.no_grad():
                apart, moved = (one_minus_cosine(both[:1], both[1:]) for both in (latents, latents - 1e-3 * gradient / gradient.norm()))
            assert float(moved) > float(apart) > 0


def test_autocast_changes_nothing_of_the_latent_loss() -> None:
    latents, frames = torch.randn(4, 32), torch.tensor([0, 5, 6, 9])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under_autocast = latent_loss(latents, frames)
    assert under_autocast.dtype == torch.float32
    assert torch.equal(under_autocast, latent_loss(latents, frames))
    assert latent_loss(latents.bfloat16(), frames).dtype == torch.float32


def test_alpha_falls_from_its_start_and_is_nothing_from_epoch_200() -> None:
    assert alpha_latent(0) == 0.0005
    assert alpha_latent(1) == pytest.approx(1.8946457081e-4, rel=1e-9)  # 0.0005 / 2^1.4
    assert alpha_latent(199) == pytest.approx(3.00281e-7, rel=1e-5)  # 0.0005 / 200^1.4
    assert alpha_latent(200) == alpha_latent(592) == 0.0
