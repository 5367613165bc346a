"""Latents that are a free vector for each training shape."""

import pytest
import torch

from sdfnet.errors import TrainingError
from sdfnet.models.learned_latents import LearnedLatents, checksums

SHAPES = 0.1 * torch.randn(6, 5, 3, generator=torch.Generator().manual_seed(3))


def test_a_training_shape_is_known_in_any_batch_and_order() -> None:
    learned = LearnedLatents(SHAPES, 4)
    some = torch.tensor([4, 1, 1])
    assert torch.equal(learned(SHAPES[some]), learned.vectors[some])


def test_a_shape_that_differs_by_one_bit_is_refused_with_the_cure() -> None:
    learned, shapes = LearnedLatents(SHAPES, 4), SHAPES.clone()
    shapes[2, 3, 1] = torch.nextafter(shapes[2, 3, 1], torch.tensor(1.0))
    message = r"knows the 6 shapes that it was trained on, found 1 of 6 that are none of them; train on all frames with split=all, or choose"
    with pytest.raises(TrainingError, match=message):
        learned(shapes)


def test_vertices_that_change_places_change_the_checksum() -> None:
    assert len(set(checksums(torch.cat([SHAPES, SHAPES.flip(1)])).tolist())) == 12


def test_equal_shapes_share_a_latent() -> None:
    learned = LearnedLatents(torch.cat([SHAPES, SHAPES[:1]]), 4)
    assert torch.equal(learned(SHAPES[:1]), learned.vectors[:1])


def test_vectors_begin_about_as_long_as_one_and_take_gradients_of_their_shape_alone() -> None:
    learned = LearnedLatents(SHAPES, 64)
    assert float(learned.vectors.detach().square().sum(dim=1).mean()) == pytest.approx(1, abs=0.3)  # six sums of 64 squares scatter by 7 %
    learned(SHAPES[2:3]).sum().backward()
    assert learned.vectors.grad is not None
    assert learned.vectors.grad.abs().sum(dim=1).nonzero().tolist() == [[2]]
