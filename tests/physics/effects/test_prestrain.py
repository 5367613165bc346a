"""Strains without stress, and the stress where they are held back."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import FixedComponents
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.prestrain import Prestrain
from sdfnet.physics.elasticity import ElasticModel, assemble, shape_gradients
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import BoxRegion
from sdfnet.physics.statics import static_solution
from sdfnet.scene import Effect, Geometry, Material, Scene, Solver

MakeBox = Callable[..., TetMesh]
ELEMENTS = ("P1", "P1_nodal_pressure", "P2")
MATERIAL = Material(youngs_modulus=3e4, poisson_ratio=0.3)


@pytest.fixture(scope="module")
def mesh(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis, jitter=0.2)


@pytest.fixture(params=ELEMENTS)
def model(request: pytest.FixtureRequest, mesh: TetMesh) -> ElasticModel:
    return assemble(mesh, MATERIAL, request.param)


def _at_rest(model: ElasticModel, **effects: Effect) -> np.ndarray:
    return static_solution(plan(Scene(Geometry(), effects, MATERIAL, solver=Solver("newmark", element=model.elements.element)), model.mesh))


def _held_at_one_corner(model: ElasticModel) -> FixedComponents:
    """The corner at the origin, and three components of two others: no strain is held back."""
    nodes, mask = model.elements.nodes, np.zeros_like(model.elements.nodes, dtype=np.bool_)
    for corner, components in (((0, 0, 0), [0, 1, 2]), ((1, 0, 0), [1, 2]), ((0, 1, 0), [2])):
        mask[np.ix_((nodes == corner).all(axis=1), components)] = True
    return FixedComponents(mask)


@pytest.mark.parametrize("heat", [Prestrain((0.02, 0.02, 0.02, 0.0, 0.0, 0.0)), Prestrain(expansion_coefficient=1e-4, temperature_change=200.0)])
def test_a_free_solid_swells_exactly_by_the_strain_without_stress(model: ElasticModel, heat: Prestrain) -> None:
    found = _at_rest(model, corner=_held_at_one_corner(model), heat=heat)
    np.testing.assert_allclose(found, 0.02 * model.elements.nodes, atol=1e-13)
    gradients = np.einsum("tia,tib->tab", found[model.mesh.tets], shape_gradients(model.mesh))
    strain = (gradients + gradients.transpose(0, 2, 1)) / 2 - heat.tensor
    stress = MATERIAL.lame_lambda * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * MATERIAL.lame_mu * strain
    np.testing.assert_allclose(stress, 0, atol=1e-12 * MATERIAL.youngs_modulus)


def test_each_component_strains_its_own_direction(model: ElasticModel) -> None:
    effect = Prestrain((0.01, 0.02, 0.03, 0.004, 0.005, 0.006))
    tensor = np.array([[0.01, 0.006, 0.005], [0.006, 0.02, 0.004], [0.005, 0.004, 0.03]])
    np.testing.assert_array_equal(effect.tensor, tensor)
    found = model.stiffness @ (model.elements.nodes @ tensor).ravel()
    np.testing.assert_allclose(effect.load(model).nodal_force.ravel(), found, atol=1e-12 * np.abs(found).max())


def test_a_solid_held_all_around_stays_and_its_walls_bear_the_stress(model: ElasticModel) -> None:
    load = Prestrain(expansion_coefficient=1e-5, temperature_change=100.0).load(model)
    wall = np.isclose(model.elements.nodes[:, 0], 1.0)
    pressure = 3 * MATERIAL.bulk_modulus * 1e-3
    np.testing.assert_allclose(load.nodal_force[wall].sum(axis=0), [pressure, 0, 0], atol=1e-12 * pressure)  # on 1 m^2
    assert load.report["stress_if_held_Pa"] == pytest.approx(pressure, rel=1e-12)
    assert load.report["largest_strain"] == pytest.approx(1e-3, rel=1e-12)
    assert load.stress == pytest.approx(1e-3 * MATERIAL.youngs_modulus, rel=1e-12)


def test_a_solid_clamped_between_two_walls_bends_out_at_its_sides(model: ElasticModel) -> None:
    wall = Pinned(BoxRegion(lower=(1.0, -1.0, -1.0)), (True, False, False))
    rollers = FixedComponents(np.isclose(model.elements.nodes, 0.0))
    found = _at_rest(model, wall=wall, rollers=rollers, heat=Prestrain((1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0)))
    sideways = (1 + MATERIAL.poisson_ratio) * 1e-3  # free to move along y and z: epsilon_yy = (1 + nu) epsilon0 where epsilon_xx = 0
    np.testing.assert_allclose(found, model.elements.nodes * [0.0, sideways, sideways], atol=1e-13)


def test_no_strain_is_no_load(model: ElasticModel) -> None:
    assert not Prestrain(expansion_coefficient=1e-5).load(model).nodal_force.any()
    assert not Prestrain(temperature_change=50.0).load(model).nodal_force.any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"strain": (0.0, 0.0, math.nan, 0.0, 0.0, 0.0)}, "prestrain.strain must be finite"),
        ({"expansion_coefficient": math.inf}, "prestrain.expansion_coefficient must be finite, found inf 1/K"),
        ({"temperature_change": math.nan}, "prestrain.temperature_change must be finite, found nan K"),
    ],
)
def test_settings_that_are_not_finite_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Prestrain(**settings)  # type: ignore[arg-type]
