"""The optimiser of each network."""

from torch import nn
from torch.optim import Adam, Optimizer

from sdfnet.training.settings import OptimizerSettings

ADAM_BETAS = {"adam": (0.9, 0.999), "soap": (0.9, 0.99)}  # PyTorch's own; beside SOAP the shorter memory that SOAP has
SOAP_BETAS = (0.95, 0.99)
SOAP_REFRESH = 10  # steps between new eigenbases; more often was slower and no better


def encoder_optimizer(settings: OptimizerSettings, encoder: nn.Module) -> Optimizer:
    """Adam, fused: the encoder's input layer is wide."""
    return Adam(encoder.parameters(), lr=settings.encoder_rate, betas=ADAM_BETAS[settings.name], fused=True)


def decoder_optimizer(settings: OptimizerSettings, decoder: nn.Module) -> Optimizer:
    """Adam or SOAP."""
    if settings.name == "adam":
        return Adam(decoder.parameters(), lr=settings.decoder_rate, betas=ADAM_BETAS[settings.name])
    from pytorch_optimizer import SOAP

    return SOAP(decoder.parameters(), lr=settings.decoder_rate, betas=SOAP_BETAS, weight_decay=0.0, precondition_frequency=SOAP_REFRESH)
