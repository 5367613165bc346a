"""The Mesh Encoder."""

import torch
from torch import nn

from sdfnet.models.encoder import MeshEncoder


def first_layer(encoder: MeshEncoder) -> nn.Linear:
    layer = encoder.layers[0]
    assert isinstance(layer, nn.Linear)
    return layer


def test_the_input_is_three_times_as_wide_as_the_mesh_has_vertices() -> None:
    for vertices in (5, 3446):
        assert first_layer(MeshEncoder(torch.rand(2, vertices, 3), [4], 2)).in_features == 3 * vertices
    assert first_layer(MeshEncoder(torch.rand(2, 3446, 3), [4], 2)).in_features == 10_338  # the paper's


def test_hidden_layers_and_latent_follow_the_settings() -> None:
    encoder = MeshEncoder(torch.rand(2, 5, 3), [256, 256, 128], 32)
    assert [layer.out_features for layer in encoder.layers if isinstance(layer, nn.Linear)] == [256, 256, 128, 32]
    assert sum(isinstance(layer, nn.ReLU) for layer in encoder.layers) == 3
    assert encoder(torch.rand(4, 5, 3)).shape == (4, 32)


def test_shapes_enter_with_mean_zero_and_length_one() -> None:
    shapes = 0.1 + 1e-3 * torch.randn(50, 20, 3)
    encoder = MeshEncoder(shapes, [4], 2)
    entered: list[torch.Tensor] = []
    first_layer(encoder).register_forward_pre_hook(lambda _, inputs: entered.append(inputs[0]))
    encoder(shapes)
    # float32 holds 0.1 m to 7e-9 m, which is 7e-6 of a deviation of 1e-3 m; summed over 50 shapes it stays below 1e-4
    assert float(entered[0].mean(dim=0).abs().max()) < 1e-4
    assert abs(float(entered[0].square().sum(dim=1).mean().sqrt()) - 1) < 1e-4


def test_moving_the_whole_family_changes_no_latent() -> None:
    shapes = torch.randn(6, 4, 3)
    encoder = MeshEncoder(shapes, [8], 2)
    moved = MeshEncoder(shapes + 5, [8], 2)
    moved.layers.load_state_dict(encoder.layers.state_dict())
    torch.testing.assert_close(moved(shapes + 5), encoder(shapes), rtol=0, atol=2e-5)  # 5 m in float32 costs 5e-7 of each coordinate


def test_a_single_shape_has_a_finite_latent() -> None:
    shapes = torch.rand(1, 4, 3)
    assert MeshEncoder(shapes, [8], 2)(shapes).isfinite().all()


def test_mean_shape_and_scale_travel_with_the_weights() -> None:
    shapes = torch.rand(3, 4, 3)
    encoder, other = MeshEncoder(shapes, [8], 2), MeshEncoder(torch.rand(3, 4, 3), [8], 2)
    other.load_state_dict(encoder.state_dict())
    assert torch.equal(other(shapes), encoder(shapes))
