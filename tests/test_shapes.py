"""The canary: if the run-time check of shapes and types is off, these fail."""

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh


def test_a_wrong_shape_raises_in_a_dataclass() -> None:
    with pytest.raises(TypeCheckError, match="vertices"):
        Surface(np.zeros((4, 2)), np.zeros((2, 3), dtype=np.int64))


def test_a_wrong_type_raises_in_a_dataclass() -> None:
    with pytest.raises(TypeCheckError, match="nodes"):
        TetMesh(np.zeros((4, 3), dtype=np.float32), np.zeros((1, 4), dtype=np.int64))


def test_two_arrays_that_should_share_an_axis_raise_in_a_method() -> None:
    surface = SurfaceDistance(Sphere(cells=2).tet_mesh().surface())
    with pytest.raises(TypeCheckError, match="upper_bound"):
        surface.signed_distance(torch.zeros(5, 3), torch.ones(4))
