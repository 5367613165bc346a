"""Effects given node by node."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.data.store import key_of
from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import FixedComponents, NodalForce, NodalStart
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.regions import Where
from sdfnet.scene import Effect, Material

MakeBox = Callable[..., TetMesh]


@pytest.fixture(scope="module", params=["P1", "P1_nodal_pressure", "P2"])
def cube(request: pytest.FixtureRequest, make_box: MakeBox) -> ElasticModel:
    return assemble(make_box([0, 1], [0, 1], [0, 1]), Material(), request.param)


def test_arrays_are_handed_on_as_they_are(cube: ElasticModel) -> None:
    values = np.random.default_rng(0).normal(size=cube.elements.nodes.shape)
    assert FixedComponents(values > 0).fixed_components(cube.elements) is not None
    np.testing.assert_array_equal(FixedComponents(values > 0).fixed_components(cube.elements), values > 0)
    load = NodalForce(values, ramp(1.0)).load(cube)
    np.testing.assert_array_equal(load.nodal_force, values)
    assert load.history == ramp(1.0)
    assert load.report["resultant_N"] == pytest.approx(np.linalg.norm(values.sum(axis=0)), rel=1e-15)
    start = NodalStart(values, -values).start(cube)
    np.testing.assert_array_equal(start.displacement, values)
    np.testing.assert_array_equal(start.velocity, -values)


def test_what_a_start_leaves_out_is_zero(cube: ElasticModel) -> None:
    values = np.ones_like(cube.elements.nodes)
    assert not NodalStart(displacement=values).start(cube).velocity.any()
    assert not NodalStart(velocity=values).start(cube).displacement.any()


def test_effects_of_other_arrays_are_not_equal(cube: ElasticModel) -> None:
    ones = np.ones_like(cube.elements.nodes)
    for first, second in (
        (NodalForce(ones), NodalForce(2 * ones)),
        (NodalStart(ones), NodalStart(2 * ones)),
        (FixedComponents(ones > 0), FixedComponents(ones < 0)),
    ):
        assert first != second
        assert first == first
        assert len({first, second}) == 2


def _ask(effect: Effect, model: ElasticModel) -> None:
    """Whatever the effect has to give."""
    if isinstance(effect, FixedComponents):
        effect.fixed_components(model.elements)
    elif isinstance(effect, NodalForce):
        effect.load(model)
    elif isinstance(effect, NodalStart):
        effect.start(model)


@pytest.mark.parametrize("name", ["fixed_components.mask", "nodal_force.force", "nodal_start.displacement", "nodal_start.velocity"])
def test_a_row_too_few_is_refused_with_both_shapes(cube: ElasticModel, name: str) -> None:
    short = np.ones((len(cube.elements.nodes) - 1, 3))
    effects: dict[str, Effect] = {"fixed_components.mask": FixedComponents(short > 0), "nodal_force.force": NodalForce(short)}
    effects |= {"nodal_start.displacement": NodalStart(displacement=short), "nodal_start.velocity": NodalStart(velocity=short)}
    count, element = len(cube.elements.nodes), cube.elements.element
    message = rf"{name} must have shape \({count}, 3\), a row for each node of the {element} elements, found \({count - 1}, 3\); make it from"
    with pytest.raises(PhysicsError, match=message):
        _ask(effects[name], cube)


def test_a_value_that_is_not_finite_is_refused_with_its_row(cube: ElasticModel) -> None:
    values = np.zeros_like(cube.elements.nodes)
    values[3, 1] = np.nan
    for effect in (NodalForce(values), NodalStart(values), NodalStart(velocity=values)):
        with pytest.raises(PhysicsError, match="must be finite, found 1 rows that are not, the first at index 3"):
            _ask(effect, cube)


def test_a_mask_that_holds_nothing_is_refused(cube: ElasticModel) -> None:
    with pytest.raises(PhysicsError, match="fixed_components.mask must hold at least one component, found none"):
        _ask(FixedComponents(np.zeros_like(cube.elements.nodes, dtype=np.bool_)), cube)


def test_files_are_not_named_by_arrays() -> None:
    with pytest.raises(
        ConfigurationError, match=r"files are named by settings, .*, found an array \(4, 3\) of float64; derive an effect or region of your own"
    ):
        key_of(NodalForce(np.ones((4, 3))))
    with pytest.raises(ConfigurationError, match="found the function <lambda>; derive .* whose fields are numbers, or stay in memory with"):
        key_of(Where(lambda points: points[:, 0] < 0))
