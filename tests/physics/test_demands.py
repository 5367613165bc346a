"""What effects ask of the simulator, put together role by role."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.demands import Demands, demands_of
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.effects.roles import AddsDamping, AddsLoad, ConstrainsNodes, Damping, ForceLaw, Load, ReplacesElasticity, SetsStart, Start
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.elements import FiniteElements
from sdfnet.physics.regions import HalfSpace
from sdfnet.scene import Effect, Geometry, Material, Scene

MakeBox = Callable[..., TetMesh]
PUSH = PressurePoke(center=(0.5, 0.5, 1.0), radius=0.2, pressure=10.0)


@dataclass(frozen=True)
class Everything(ConstrainsNodes, AddsLoad, AddsDamping, SetsStart):
    """Has every linear role at once, and keeps which of its functions were called."""

    calls: list[str] = field(default_factory=list)

    def fixed_components(self, elements: FiniteElements) -> np.ndarray:
        self.calls.append("fixed_components")
        return np.repeat(elements.nodes[:, 2:] == 0, 3, axis=1)

    def load(self, model: ElasticModel) -> Load:
        self.calls.append("load")
        return Load(np.ones(model.elements.nodes.shape), stress=2.0, report={"size_N": 3.5}, history=ramp(0.1))

    def damping(self, model: ElasticModel) -> Damping:
        self.calls.append("damping")
        return Damping(1.0, 2e-5)

    def start(self, model: ElasticModel) -> Start:
        self.calls.append("start")
        return Start(np.full(model.elements.nodes.shape, 0.1), np.ones(model.elements.nodes.shape))


@dataclass(frozen=True)
class Nonlinear(ReplacesElasticity):
    """Takes the place of the elastic force."""

    law: ForceLaw

    def elastic_law(self, model: ElasticModel) -> ForceLaw:
        return self.law


@pytest.fixture(scope="module")
def model(make_box: MakeBox) -> ElasticModel:
    axis = np.linspace(0, 1, 4)
    return assemble(make_box(axis, axis, axis), Material())


@pytest.fixture
def law(model: ElasticModel, make_springs: Callable[..., ForceLaw]) -> ForceLaw:
    return make_springs(model)


def asked(model: ElasticModel, **effects: Effect) -> Demands:
    return demands_of(Scene(Geometry(), effects), model)


def test_an_effect_is_asked_once_for_each_of_its_roles(model: ElasticModel, caplog: pytest.LogCaptureFixture) -> None:
    effect = Everything()
    with caplog.at_level(logging.WARNING):
        demands = asked(model, all=effect)
    assert sorted(effect.calls) == ["damping", "fixed_components", "load", "start"]
    assert demands.lines == [
        "all: Everything fixes 48 components of 16 nodes and adds a load over time from 0 to 0.1 s (size_N 3.5) "
        "and damps with C = 1/s M + 2e-05 s K and starts the solid with 1.732 m/s and 0.1732 m at most"
    ]
    assert demands.report == {"all_size_N": 3.5}
    assert (demands.damping, demands.stress, demands.moves) == (Damping(1.0, 2e-5), 2.0, True)
    np.testing.assert_array_equal(demands.start.velocity, np.where(demands.fixed, 0.0, 1.0))  # what is fixed does not move
    np.testing.assert_array_equal(demands.start.displacement, np.where(demands.fixed, 0.0, 0.1))
    assert caplog.messages == [
        "the scene starts 48 fixed components of 16 nodes with up to 0.1 m and 1 m/s: they stay where they are; start only what is free, or pin less"
    ]


def test_a_start_of_what_is_free_is_not_warned_of(model: ElasticModel, caplog: pytest.LogCaptureFixture) -> None:
    throw = InitialMotion((1.0, 0.0, 0.0), region=HalfSpace((0.0, 0.0, 0.3), (0.0, 0.0, -1.0)))
    with caplog.at_level(logging.WARNING):
        assert asked(model, foot=Pinned(), throw=throw).start.velocity.any()
        assert not caplog.messages
        asked(model, roller=Pinned(components=(False, False, True)), throw=InitialMotion((1.0, 0.0, -2.0)))
    assert caplog.messages[0].startswith("the scene starts 16 fixed components of 16 nodes with up to 0 m and 2 m/s")


def test_damping_and_starts_of_several_effects_add_up(model: ElasticModel) -> None:
    demands = asked(model, a=RayleighDamping(1.0, 0.0), b=RayleighDamping(2.0, 1e-4), c=InitialMotion((1.0, 0.0, 0.0)), d=InitialMotion((0.0, 2.0, 0.0)))
    assert demands.damping == Damping(3.0, 1e-4)
    np.testing.assert_array_equal(demands.start.velocity, np.broadcast_to([1.0, 2.0, 0.0], demands.start.velocity.shape))
    assert demands.moves


def test_lines_follow_the_order_of_the_scene(model: ElasticModel) -> None:
    lines = asked(model, push=PUSH, damping=RayleighDamping(1.0), foot=Pinned()).lines
    assert [line.split(":")[0] for line in lines] == ["push", "damping", "foot"]


def test_a_scene_without_effects_asks_for_nothing(model: ElasticModel) -> None:
    demands = asked(model)
    assert not any(values.any() for values in (demands.fixed, demands.start.displacement, demands.start.velocity))
    assert not demands.moves
    assert (demands.loads, demands.case_loads, demands.laws, demands.lines, demands.report) == ({}, {}, {}, [], {})
    assert (demands.stress, demands.stable_fraction) == (0, 1.0)
    assert not demands.added_stiffness.any()


def test_force_laws_add_their_stiffness_and_the_least_fraction_counts(model: ElasticModel, on_springs: Callable[..., Effect]) -> None:
    demands = asked(model, foot=Pinned(), soft=on_springs(share=0.1), hard=on_springs(share=0.3, speed=1.0))
    assert list(demands.laws) == ["soft", "hard"]
    np.testing.assert_allclose(demands.added_stiffness, 0.4 * model.stiffness.diagonal().max(), rtol=1e-12)
    demands.laws["soft"].stable_fraction = 0.7
    assert demands.stable_fraction == 0.7
    assert demands.moves  # the far ends of the hard springs do
    assert not asked(model, foot=Pinned(), soft=on_springs()).moves


def test_one_effect_may_replace_the_elastic_force(model: ElasticModel, law: ForceLaw) -> None:
    demands = asked(model, foot=Pinned(), push=PUSH, rubber=Nonlinear(law))
    assert demands.replaces_elasticity
    assert demands.laws == {"rubber": law}
    assert demands.lines[-1] == "rubber: Nonlinear takes the place of the linear elastic force, and is computed at every step"
    with pytest.raises(ConfigurationError, match="only one effect may replace the linear elastic force, found 'gel' beside another; remove one"):
        asked(model, rubber=Nonlinear(law), gel=Nonlinear(law))


def test_stiffness_damping_without_the_linear_force_is_refused_and_mass_damping_is_not(model: ElasticModel, law: ForceLaw) -> None:
    with pytest.raises(ConfigurationError, match="which another effect replaces here; use the mass-proportional part"):
        asked(model, rubber=Nonlinear(law), damping=RayleighDamping(0.0, 1e-5))
    assert asked(model, rubber=Nonlinear(law), damping=RayleighDamping(1.0)).damping == Damping(1.0)
