"""Natural frequencies and shapes on the nodes of the elements."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import diags

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import NodalStart
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.plan import plan
from sdfnet.physics.simulate import simulate
from sdfnet.physics.vibration import natural_frequencies
from sdfnet.scene import Effect, Geometry, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]


@pytest.fixture(scope="module")
def beam(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 1, 3), np.linspace(0, 0.7, 3), np.linspace(0, 2, 4))


def held(element: str = "P1", mass: str = "lumped") -> Scene:
    return Scene(Geometry(), {"foot": Pinned()}, solver=Solver("newmark", mass, element))


@pytest.mark.parametrize("element", ["P1", "P1_nodal_pressure", "P2"])
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_shapes_are_of_unit_mass_at_rest_where_held_and_carry_their_frequency(beam: TetMesh, element: str, mass: str) -> None:
    compiled = plan(held(element, mass), beam)
    found = natural_frequencies(compiled, 5)
    model = compiled.model
    matrix = diags(model.lumped_mass) if mass == "lumped" else model.consistent_mass
    assert found.shapes.shape == (5, *model.elements.nodes.shape)
    assert not found.shapes[:, compiled.fixed].any()
    products = np.array([[(one * (matrix @ other)).sum() for other in found.shapes] for one in found.shapes])
    np.testing.assert_allclose(products, np.eye(5), atol=1e-9)
    strains = [shape.ravel() @ model.stiffness @ shape.ravel() for shape in found.shapes]
    np.testing.assert_allclose(strains, found.angular_frequencies**2, rtol=1e-9)
    assert (np.diff(found.angular_frequencies) >= 0).all()
    np.testing.assert_array_equal(found.frequencies, found.angular_frequencies / (2 * np.pi))


def test_a_solid_that_starts_in_a_mode_swings_with_its_frequency(beam: TetMesh) -> None:
    mode = natural_frequencies(plan(held(), beam), 1)
    period = 1 / mode.frequencies[0]
    swing = replace(held(), effects={"foot": Pinned(), "start": NodalStart(mode.shapes[0])}, recording=Recording(period, 5), solver=Solver("exact"))
    found = simulate(swing, beam).displacements
    for frame, cosine in enumerate((1, 0, -1, 0, 1)):
        np.testing.assert_allclose(found[frame], cosine * mode.shapes[0], atol=1e-8 * np.abs(mode.shapes[0]).max())


def test_frequencies_need_a_linear_scene(beam: TetMesh, on_springs: type[Effect]) -> None:
    scene = replace(held(), effects={"springs": on_springs()}, solver=Solver("leapfrog"))
    with pytest.raises(ConfigurationError, match="natural frequencies needs? a linear scene, found the force law of 'springs'"):
        natural_frequencies(plan(scene, beam), 1)


def test_more_modes_than_there_are_is_refused(beam: TetMesh) -> None:
    with pytest.raises(ConfigurationError, match=r"must lie between 1 and the \d+ free degrees of freedom, found 1000"):
        natural_frequencies(plan(held(), beam), 1000)
