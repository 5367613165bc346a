"""A force density turned into a load."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.elasticity import assemble
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]


def test_weight_sums_to_that_of_the_solid_and_scales_its_stress_with_the_diagonal(make_box: MakeBox) -> None:
    model = assemble(make_box([0, 1, 2], [0, 1], [0, 2]), Material(density=3.0))
    load = BodyForce(density=(0.0, 0.0, -3.0 * 9.81)).load(model)
    np.testing.assert_allclose(load.nodal_force, np.outer(model.lumped_mass, [0, 0, -9.81]), atol=1e-12)
    assert load.report["resultant_N"] == pytest.approx(9.81 * 3.0 * 4.0, rel=1e-12)
    assert load.stress == pytest.approx(9.81 * 3.0 * 3.0, rel=1e-12)


def test_no_force_loads_nothing(make_box: MakeBox) -> None:
    load = BodyForce(density=(0.0, 0.0, 0.0)).load(assemble(make_box([0, 1], [0, 1], [0, 1]), Material()))
    assert not load.nodal_force.any()
    assert (load.stress, load.report["resultant_N"]) == (0.0, 0.0)


def test_an_infinite_force_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="body_force.density must be finite"):
        BodyForce(density=(math.inf, 0.0, 0.0))
