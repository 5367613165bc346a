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


@pytest.mark.parametrize("density", [(0.0, 0.0, 0.0), (math.inf, 0.0, 0.0)])
def test_no_force_and_an_infinite_one_are_refused(density: tuple[float, float, float]) -> None:
    with pytest.raises(ConfigurationError, match="body_force.density must be finite and not zero"):
        BodyForce(density=density)
