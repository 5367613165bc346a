"""The energies of a state against closed forms, and their sum over a run."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.energies import energies
from sdfnet.physics.plan import plan
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
MATERIAL = Material(3e3, 0.25, 2.0)
VOLUME = 2 * 1 * 1.5


@pytest.fixture(scope="module")
def block(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 2, 4), np.linspace(0, 1, 3), np.linspace(0, 1.5, 3), jitter=0.2)


@pytest.mark.parametrize("element", ["P1", "P1_nodal_pressure", "P2"])
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_energies_of_an_even_strain_and_velocity_are_density_times_volume(block: TetMesh, element: str, mass: str) -> None:
    scene = Scene(Geometry(), {"weight": BodyForce((0.0, 0.0, -6.0))}, MATERIAL, solver=Solver("newmark", mass, element))
    compiled = plan(scene, block)
    nodes = compiled.model.elements.nodes
    strain, velocity = np.diag([0.01, -0.02, 0.005]), np.array([1.0, -2.0, 0.5])
    found = energies(compiled, nodes @ strain, np.broadcast_to(velocity, nodes.shape).copy())
    stress = MATERIAL.lame_lambda * np.trace(strain) * np.eye(3) + 2 * MATERIAL.lame_mu * strain
    assert found.kinetic == pytest.approx(0.5 * 2.0 * VOLUME * (velocity @ velocity), rel=1e-12)
    assert found.strain == pytest.approx(0.5 * np.sum(stress * strain) * VOLUME, rel=1e-12)
    assert found.load == pytest.approx(6.0 * 0.005 * 0.75 * VOLUME, rel=1e-12)  # the centre rises by 0.005 * 0.75
    assert found.laws == 0
    assert found.total == found.kinetic + found.strain + found.load


def test_the_total_is_kept_while_the_parts_change(block: TetMesh) -> None:
    scene = Scene(Geometry(), {"foot": Pinned(), "weight": BodyForce((0.0, 1.0, -6.0))}, MATERIAL, Recording(0.5, 2), Solver("newmark"))
    compiled = plan(scene, block)
    integrator, _ = compiled.compile()
    state = integrator.initial_state()
    seen = []
    for _ in range(20):
        seen.append(energies(compiled, integrator.motion.nodal(state.displacement).numpy(), integrator.motion.nodal(state.velocity).numpy()))
        integrator.advance(state, 3)
    largest = max(one.strain for one in seen)
    assert largest > 1e-6
    assert max(one.kinetic for one in seen) > 0.1 * largest
    np.testing.assert_allclose([one.total for one in seen], 0, atol=1e-11 * largest)  # Newmark keeps it to rounding


def test_a_load_counts_as_strong_as_it_is_at_the_time(block: TetMesh) -> None:
    weight = BodyForce((0.0, 0.0, -6.0), ramp(2.0))
    compiled = plan(Scene(Geometry(), {"foot": Pinned(), "weight": weight}, MATERIAL, solver=Solver("newmark", time_step=1e-3)), block)
    raised = np.broadcast_to([0.0, 0.0, 0.1], block.nodes.shape).copy()
    found = [energies(compiled, raised, 0 * raised, time).load for time in (0.0, 0.5, 3.0)]
    np.testing.assert_allclose(found, [0, 0.25 * 1.8, 1.8], rtol=1e-12)  # 6 N/m^3 * 3 m^3 * 0.1 m at full strength


def test_a_load_case_acts_beside_the_effects_and_must_be_named(block: TetMesh) -> None:
    cases: dict[str, Effect] = {"up": BodyForce((0.0, 0.0, 6.0)), "down": BodyForce((0.0, 0.0, -2.0))}
    scene = Scene(Geometry(), {"foot": Pinned(), "weight": BodyForce((0.0, 0.0, -6.0))}, MATERIAL, solver=Solver("newmark"), load_cases=cases)
    compiled = plan(scene, block)
    raised = np.broadcast_to([0.0, 0.0, 0.1], block.nodes.shape).copy()
    assert energies(compiled, raised, 0 * raised, case="up").load == pytest.approx(0, abs=1e-12)
    assert energies(compiled, raised, 0 * raised, case="down").load == pytest.approx(2.4, rel=1e-12)
    for wrong in (None, "sideways"):
        with pytest.raises(ConfigurationError, match=r"one of the scene's load cases \['up', 'down'\], found"):
            energies(compiled, raised, 0 * raised, case=wrong)
    single = plan(replace(scene, load_cases={}), block)
    with pytest.raises(ConfigurationError, match=r"load cases \[\], found up; .*None if it has none"):
        energies(single, raised, 0 * raised, case="up")


def test_what_force_laws_store_is_apart(block: TetMesh, on_springs: type[Effect]) -> None:
    scene = Scene(Geometry(), {"springs": on_springs()}, MATERIAL)
    compiled = plan(scene, block)
    moved = np.broadcast_to([0.1, 0.0, 0.0], block.nodes.shape).copy()
    found = energies(compiled, moved, 0 * moved)
    spring = 0.1 * float(compiled.model.stiffness.diagonal().max())
    assert found.laws == pytest.approx(0.5 * spring * 0.01 * len(block.nodes), rel=1e-12)
    assert found.strain == pytest.approx(0, abs=1e-12)
