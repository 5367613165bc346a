"""Whole runs of what breaks simulators: finished and right, or refused with the cure; never NaN, never silence."""

import logging
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.errors import PhysicsError
from sdfnet.geometry.solids import Box, MeshedGeometry, Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.energy_watch import ENERGY_TOLERANCE, LAW_TOLERANCE
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.simulate import SimulationStopped, run, simulate
from sdfnet.scene import Recording, Scene, Solver

Solution = Callable[[Plan], np.ndarray]
CUBE = Box(size=(1.0, 1.0, 1.0), cells=(3, 3, 3))
PUSHED = Scene(CUBE, {"foot": Pinned(), "push": PressurePoke((0.5, 0.5, 1.0), 0.25, 10.0)}, recording=Recording(4e-3, 5))
TOLERANCE = {"leapfrog": 1e-4, "symplectic_euler": 0.02, "newmark": 1e-3, "modal": 1e-8, "exact": 1e-8}  # by their orders; modal has all modes
STRONG = 100 * 4000.0  # Pa, a hundred times the paper's
POKED: dict[str, tuple[MeshedGeometry, PressurePoke, Pinned]] = {
    "ball": (Sphere(cells=6), PressurePoke((0.05, 0.0, 0.0), 0.012, STRONG), Pinned(HalfSpace((0.0, 0.0, -0.04)))),
    "box": (Box((0.1, 0.1, 0.1), (4, 4, 4)), PressurePoke((0.05, 0.05, 0.1), 0.012, STRONG), Pinned()),
}


def with_sliver(mesh: TetMesh, tet: int, aspect: float) -> TetMesh:
    """The mesh with a node put into a tet, this much of its altitude over the face of its first three corners: the last tet is flat."""
    corners = mesh.tets[tet]
    shares = np.array([(1 - 1 / aspect) / 3] * 3 + [1 / aspect])
    parts = np.repeat(corners[None], 4, axis=0)
    parts[np.arange(4), np.arange(4)] = len(mesh.nodes)
    return TetMesh(np.concatenate([mesh.nodes, (shares @ mesh.nodes[corners])[None]]), np.concatenate([np.delete(mesh.tets, tet, axis=0), parts]))


@pytest.fixture(scope="module")
def flat() -> TetMesh:
    return with_sliver(CUBE.tet_mesh(), 80, 1e4)


def test_a_sliver_is_named_with_the_step_it_costs(flat: TetMesh) -> None:
    whole, compiled = plan(PUSHED, CUBE.tet_mesh()), plan(PUSHED, flat)
    assert flat.smallest_altitudes[-1] < 1.1e-4 * CUBE.tet_mesh().smallest_edge
    assert compiled.steps > 20 * whole.steps
    assert compiled.limits is not None
    assert compiled.limits.governing_tet == len(flat.tets) - 1
    found = re.search(r"governed by tet 164 at .*, smallest altitude 3.33e-05 m; without .* would be ([\d.]+) times as large", compiled.describe())
    assert found is not None
    assert float(found[1]) > 1000  # of its own frequency; its nodes share the mass of their other tets, so that the true step loses less


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_solid_with_a_sliver_moves_right(flat: TetMesh, exact_in_time: Solution, integrator: str, mass: str) -> None:
    if mass == "consistent" and "a consistent mass" in INTEGRATORS[integrator].refuses:
        pytest.skip("it has no consistent mass")
    compiled = plan(replace(PUSHED, solver=Solver(integrator, mass, modes=1000)), flat)
    found, exact = run(compiled), exact_in_time(compiled)
    np.testing.assert_allclose(found.displacements, exact, rtol=0, atol=TOLERANCE[integrator] * np.abs(exact).max())
    assert float(found.report["energy_drift"]) <= 1e-4 * ENERGY_TOLERANCE


@pytest.mark.parametrize("integrator", ["leapfrog", "newmark", "modal", "exact"])
@pytest.mark.parametrize("solid", POKED)
def test_a_linear_solid_poked_a_hundred_times_too_hard_is_run_right_and_refused_as_a_shape(
    solid: str, integrator: str, caplog: pytest.LogCaptureFixture
) -> None:
    geometry, poke, foot = POKED[solid]
    scene = Scene(geometry, {"foot": foot, "poke": poke}, recording=Recording(1e-3, 11), solver=Solver(integrator))
    gentle = replace(scene, effects={"foot": foot, "poke": replace(poke, pressure=1e-4 * poke.pressure)})
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics"):
        expected = simulate(gentle, geometry.tet_mesh())
        assert caplog.messages == []
        found = run(plan(scene, geometry.tet_mesh()))
    np.testing.assert_allclose(found.displacements, 1e4 * expected.displacements, rtol=0, atol=1e-10 * np.abs(found.displacements).max())
    assert float(found.report["energy_drift"]) <= 1e-4 * ENERGY_TOLERANCE
    assert caplog.messages[0].startswith("outside linear elasticity: the load is 80 of Young's modulus")
    assert caplog.messages[1].startswith("outside linear elasticity: the displacement gradient reaches")
    assert caplog.messages[2].startswith("10 frames hold inverted tets")
    with pytest.raises(PhysicsError, match="no solid deforms so. Weaken the loads, which are 80 of Young's modulus"):
        simulate(scene, geometry.tet_mesh())


@pytest.mark.parametrize("solid", POKED)
@pytest.mark.parametrize("safety", [0.9, 0.1])
def test_a_hyperelastic_solid_poked_a_hundred_times_too_hard_is_stopped_with_the_cure(solid: str, safety: float) -> None:
    geometry, poke, foot = POKED[solid]
    effects = {"foot": foot, "poke": poke, "strain": FiniteStrain()}
    scene = Scene(geometry, effects, recording=Recording(1e-2, 101), solver=Solver(safety=safety))
    with pytest.raises(SimulationStopped, match="lower solver.time_step or solver.safety, or weaken the loads, which are 80 of Young's modulus") as caught:
        simulate(scene, geometry.tet_mesh())
    kept = caught.value.trajectory
    assert len(kept.times) >= 2
    assert np.isfinite(kept.displacements).all()


def test_a_shorter_step_cures_a_hyperelastic_solid_that_was_stopped() -> None:
    geometry, poke, foot = POKED["box"]
    scene = Scene(geometry, {"foot": foot, "poke": poke, "strain": FiniteStrain()}, recording=Recording(1e-3, 11))
    with pytest.raises(SimulationStopped):
        simulate(scene, geometry.tet_mesh())
    found, reference = (run(plan(replace(scene, solver=Solver(safety=safety)), geometry.tet_mesh())).displacements for safety in (0.01, 0.003))
    assert np.linalg.norm(found - reference) < 0.05 * np.linalg.norm(reference)  # 0.028, where single tets turn over in one run and not yet in the other
    assert np.abs(reference).max() > 10 * geometry.tet_mesh().diagonal  # as far from linear as that


@pytest.mark.parametrize("solid", POKED)
def test_a_weaker_load_cures_a_hyperelastic_solid_that_was_stopped(solid: str) -> None:
    geometry, poke, foot = POKED[solid]
    effects = {"foot": foot, "poke": replace(poke, pressure=0.01 * poke.pressure), "strain": FiniteStrain()}
    found = simulate(Scene(geometry, effects, recording=Recording(1e-2, 101)), geometry.tet_mesh())
    assert np.isfinite(found.displacements).all()
    assert float(found.report["law_energy_error"]) <= LAW_TOLERANCE
