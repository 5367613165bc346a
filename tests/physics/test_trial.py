"""The coordinates and numbers of a trial, each against what it stands for."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.geometry.solids import Box, Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.advice.numbers import deformation
from sdfnet.physics.advice.quadratic_tets import QuadraticTets, entries_beside_linear
from sdfnet.physics.advice.reduced_laws import counterpart_element, finite_strain_excess
from sdfnet.physics.advice.trial import Trial
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.inclusion import Inclusion
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rigid_finger import RigidFinger
from sdfnet.physics.elasticity import assemble
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import Ball
from sdfnet.physics.simulate import run
from sdfnet.physics.statics import static_solution
from sdfnet.scene import Geometry, Material, Recording, Scene, Solver

BLOCK = Box((0.1, 0.1, 0.1), (5, 5, 5)).tet_mesh()
COARSE = Box((0.1, 0.1, 0.1), (2, 2, 2)).tet_mesh()
BALL = TetMesh(Sphere(0.05, 4).tet_mesh().nodes + [0.0, 0.0, 0.051], Sphere(0.05, 4).tet_mesh().tets)
THROWN = Scene(Geometry(), {"throw": InitialMotion(velocity=(0.0, 0.0, -1.0))}, recording=Recording(0.005, 21))


def test_a_finger_alone_moves_the_trial_as_it_does_the_solid() -> None:
    finger = RigidFinger(center=(0.05, 0.05, 0.131), radius=0.03, speed=5.0, travel=0.011)
    compiled = plan(Scene(Geometry(), {"foot": Pinned(), "finger": finger}, recording=Recording(0.004, 11)), BLOCK)
    sizes = [np.linalg.norm(displacements) for displacements in (Trial(compiled).displacements, run(compiled).displacements)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.3)  # the trial's contact gives way as a whole


def test_a_stiffer_floor_does_not_throw_the_trial() -> None:
    laws = [{"floor": FloorContact(stiffness_factor=factor)} for factor in (10.0, 1e5)]
    soft, stiff = (Trial(plan(replace(THROWN, effects={**THROWN.effects, **law}), BALL)) for law in laws)
    assert stiff.size == pytest.approx(soft.size, rel=0.1)  # the softer one gives way by a tenth of an edge at most


def test_answers_of_linear_tets_beside_quadratic_ones_are_those_of_linear_tets() -> None:
    effects = {"foot": Pinned(), "weight": Gravity((1.0, 2.0, 3.0))}
    quadratic, linear = (plan(Scene(Geometry(), effects, solver=Solver("newmark", element=element)), BLOCK) for element in ("P2", "P1"))
    _, answers, _ = counterpart_element(quadratic)
    found = np.zeros(quadratic.fixed.size)
    motion = quadratic.equation()
    found[motion.free] = answers(motion.constant_force)[:, 0]
    exact = static_solution(linear)
    tolerance = 1e-6 * np.abs(exact).max()  # of which the factor's shift takes its part
    np.testing.assert_allclose(found.reshape(-1, 3)[: len(BLOCK.nodes)], exact, atol=tolerance, rtol=0)


def test_a_rigid_turn_is_read_as_its_angle() -> None:
    angle = 0.5
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    turned = (BLOCK.nodes @ turn.T - BLOCK.nodes)[None]
    found = deformation(BLOCK, np.concatenate([0 * turned, turned]), np.array([0.0, 0.1]))
    assert found.rotation == pytest.approx(angle)
    assert found.gradient == pytest.approx(math.sqrt(8) * math.sin(angle / 2))
    assert found.speed == pytest.approx(10 * np.linalg.norm(turned, axis=2).max())


def test_coordinates_are_orthogonal_in_mass_and_stiffness_after_every_law() -> None:
    trial = Trial(plan(replace(THROWN, effects={**THROWN.effects, "floor": FloorContact(), "finite": FiniteStrain()}), BALL))
    model = trial.model
    squared = model.shapes.T @ (trial.stiffness @ model.shapes)
    assert len(model.squared) > 20
    np.testing.assert_allclose(model.shapes.T @ trial.mass.product(model.shapes), np.eye(len(model.squared)), atol=1e-9)
    np.testing.assert_allclose(squared, np.diag(model.squared), atol=1e-9 * model.squared.max())  # else laws would do work from nowhere


def test_finite_strain_changes_quadratic_elements_about_as_much_as_linear_ones() -> None:
    effects = {"foot": Pinned(), "poke": PressurePoke((0.05, 0.05, 0.1), 0.02, 400.0)}
    changes = {}
    for element, cells in (("P1", 5), ("P1_nodal_pressure", 5), ("P2", 3)):
        mesh = Box((0.1, 0.1, 0.1), (cells, cells, cells)).tet_mesh()
        compiled = plan(Scene(Geometry(), effects, recording=Recording(0.01, 21), solver=Solver("newmark", element=element)), mesh)
        changes[element] = Trial(compiled).law_change(finite_strain_excess(compiled))
    assert changes["P1_nodal_pressure"] == pytest.approx(changes["P1"], rel=0.7)  # softer, and so strained more
    assert changes["P2"] == pytest.approx(changes["P1"], rel=0.7)


@pytest.mark.parametrize("poisson_ratio", [0.0, 0.45])
def test_quadratic_tets_without_a_matrix_are_those_of_the_assembly(poisson_ratio: float) -> None:
    scene = Scene(Geometry(), {"foot": Pinned(), "core": Inclusion(Ball((0.05, 0.05, 0.05), 0.04), Material(2e4, poisson_ratio))}, Material(poisson_ratio=0.3))
    linear, quadratic = (plan(replace(scene, solver=Solver("newmark", element=element)), COARSE) for element in ("P1", "P2"))
    tets = QuadraticTets(linear.model, linear.fixed)
    nodes, generator = len(COARSE.nodes), np.random.default_rng(0)
    held = np.concatenate([linear.fixed, linear.fixed[tets.ends].all(axis=1)])
    displacement = np.where(held, 0.0, generator.normal(size=held.shape))
    elements = quadratic.model.elements
    order = [int(np.flatnonzero(np.isclose(elements.nodes, COARSE.nodes[ends].mean(axis=0), atol=1e-12).all(axis=1))[0]) for ends in tets.ends]
    whole = np.zeros(elements.nodes.shape)
    whole[:nodes], whole[order] = displacement[:nodes], displacement[tets.ends].mean(axis=1) + displacement[nodes:]
    force = (quadratic.model.stiffness @ whole.ravel()).reshape(-1, 3)
    expected = np.concatenate([force[:nodes], force[order]])
    for end in (0, 1):  # of the force at a middle every end takes half
        np.add.at(expected, tets.ends[:, end], force[order] / 2)
    np.testing.assert_allclose(tets.product(displacement), np.where(held, 0.0, expected), atol=1e-12 * np.abs(force).max())


def test_the_matrix_of_quadratic_tets_is_counted_without_it(make_box: Callable[..., TetMesh]) -> None:
    mesh = make_box([0, 1, 2], [0, 1, 3], [0, 1], jitter=0.0)
    jittered = TetMesh(mesh.nodes + np.random.default_rng(0).uniform(-0.1, 0.1, mesh.nodes.shape), mesh.tets)  # on a grid entries cancel
    linear, quadratic = (assemble(jittered, Material(), element) for element in ("P1", "P2"))
    assert entries_beside_linear(linear) == pytest.approx(quadratic.stiffness.nnz / linear.stiffness.nnz, rel=1e-12)
