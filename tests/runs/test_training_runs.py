"""Whole small runs through Lightning: a stopped run that is resumed ends where an uninterrupted one does, bit for bit on the CPU."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from sdfnet.cli.commands import TimedCheckpoint, steps_are_numbers
from sdfnet.data.datamodule import BatchSettings, ShapeFamily
from sdfnet.geometry.solids import Sphere
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.scene import Dataset, Material, Recording, Sampling, Scene
from sdfnet.training.cycle import Phase
from sdfnet.training.module import SdfTraining
from sdfnet.training.schedules import Plateau
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
