"""Latents that are the coefficients of modes."""

import numpy as np
import pytest
import torch

from sdfnet.errors import ConfigurationError
from sdfnet.models.pod import PodLatents

SHAPES = 0.1 + 1e-3 * torch.randn(12, 9, 3, generator=torch.Generator().manual_seed(2))


def test_latents_are_those_of_the_singular_value_decomposition_but_for_their_sign() -> None:
    centred = SHAPES.double().numpy().reshape(12, 27) - SHAPES.double().numpy().reshape(12, 27).mean(axis=0)
    left, _, _ = np.linalg.svd(centred, full_matrices=False)
    expected = torch.from_numpy(left[:, :5] * np.sqrt(12))
    found = PodLatents(SHAPES, 5)(SHAPES).double()
    signs = (found * expected).sum(dim=0).sign()
    # positions of 0.1 m are rounded by 4e-9, modes have deviations of about 5e-3: 1e-6 of one
    torch.testing.assert_close(found * signs, expected, rtol=0, atol=2e-5)


def test_latents_of_the_training_shapes_have_mean_zero_and_are_white() -> None:
    latents = PodLatents(SHAPES, 6)(SHAPES).double()
    torch.testing.assert_close(latents.mean(dim=0), torch.zeros(6).double(), rtol=0, atol=1e-4)
    torch.testing.assert_close(latents.T @ latents / 12, torch.eye(6).double(), rtol=0, atol=1e-4)


def test_a_shape_that_was_not_trained_on_is_projected() -> None:
    pod = PodLatents(SHAPES, 3)
    coefficients = torch.tensor([[0.5, -2.0, 3.0]])
    outside = torch.randn(1, 27)
    outside -= outside @ pod.modes.T @ pod.modes
    shape = pod.mean_shape + (coefficients * pod.deviations @ pod.modes + 0.01 * outside).view(1, 9, 3)
    torch.testing.assert_close(pod(shape), coefficients, rtol=0, atol=2e-4)  # float32 shapes about 0.1 m, deviations of 5 mm


def test_modes_are_the_same_each_time_and_never_train() -> None:
    pod = PodLatents(SHAPES, 4)
    assert torch.equal(pod.modes, PodLatents(SHAPES, 4).modes)
    assert float(pod.modes.gather(1, pod.modes.abs().argmax(dim=1, keepdim=True)).min()) > 0
    assert not any(weights.requires_grad for weights in pod.parameters())


def test_more_modes_than_the_shapes_have_are_refused() -> None:
    in_a_plane = SHAPES[:1] + (1e-3 * torch.rand(8, 2) @ torch.randn(2, 27)).view(8, 9, 3)
    assert PodLatents(in_a_plane, 2)(in_a_plane).isfinite().all()
    with pytest.raises(ConfigurationError, match=r"model.latents=pod needs model.latent=3 modes, found 2 in 8 training shapes; lower model.latent"):
        PodLatents(in_a_plane, 3)
