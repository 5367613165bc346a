"""How a query point enters the SDF Calculator."""

import math

import pytest
import torch
from jaxtyping import TypeCheckError

from sdfnet.models.encodings import FourierFeatures, IdentityEncoding, encoding_of
from sdfnet.models.settings import ModelSettings


def test_features_are_the_sines_then_the_cosines_of_the_same_phases() -> None:
    encoding = FourierFeatures(5, 1.2)
    points = torch.rand(7, 3) * 2 - 1
    phases = points.double() @ encoding.frequencies.double()
    # float32 rounds a phase of about ten radians by 1e-6
    torch.testing.assert_close(encoding(points).double(), torch.cat([phases.sin(), phases.cos()], dim=1), rtol=0, atol=5e-6)


def test_input_and_its_length_come_before_the_waves_where_they_are_asked_for() -> None:
    encoding = encoding_of(ModelSettings(encoding="fourier", frequencies=5, include_input=True), torch.ones(3))
    points = torch.tensor([[2.0, -1.0, 2.0], [0.0, 0.0, 0.0]], requires_grad=True)
    features = encoding(points)
    assert features.shape == (2, encoding.features)
    assert features[:, :4].tolist() == [[2.0, -1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 0.0]]
    waves = encoding_of(ModelSettings(encoding="fourier", frequencies=5), torch.ones(3))(points)
    assert torch.equal(features[:, 4:], waves)
    (gradients,) = torch.autograd.grad(features.sum(), points)
    assert gradients.isfinite().all()  # at the centre too, where the distance has a kink


def test_frequencies_spread_by_pi_times_the_scale() -> None:
    # 30,000 normal numbers give their deviation to 0.4 %; four times that is allowed
    assert float(FourierFeatures(10_000, 1.5).frequencies.std()) == pytest.approx(1.5 * math.pi, rel=0.016)


def test_frequencies_are_a_function_of_their_seed_alone() -> None:
    first = FourierFeatures(4, 1.0).frequencies
    torch.manual_seed(99)
    assert torch.equal(first, FourierFeatures(4, 1.0).frequencies)
    assert not torch.equal(first, FourierFeatures(4, 1.0, seed=1).frequencies)


def test_frequencies_are_saved_but_never_learned() -> None:
    encoding = FourierFeatures(4, 1.0)
    assert list(encoding.parameters()) == []
    assert set(encoding.state_dict()) == {"frequencies"}


def test_phases_keep_float32_under_autocast() -> None:
    encoding, points = FourierFeatures(16, 2.0), torch.rand(50, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under_autocast = encoding(points)
    assert torch.equal(under_autocast, encoding(points))


def test_an_encoding_is_found_by_its_name_and_says_its_width() -> None:
    points = torch.rand(2, 6, 3)
    for kind, width in (("none", 3), ("fourier", 10), ("hash_grid", 12), ("dense_grid", 4)):
        encoding = encoding_of(ModelSettings(encoding=kind, frequencies=5, grid_levels=3, grid_features=4), torch.ones(3))
        assert encoding.features == width
        assert encoding(points).shape == (2, 6, width)
    assert torch.equal(IdentityEncoding()(points), points)


def test_a_wrong_shape_is_caught_where_it_enters() -> None:
    with pytest.raises(TypeCheckError):
        FourierFeatures(4, 1.0)(torch.rand(7, 2))
