"""Static solutions against closed forms, and what is said when there is none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics import statics
from sdfnet.physics.effects.arrays import FixedComponents
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.history import History, ramp
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.effects.traction import Traction
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.simulate import simulate
from sdfnet.physics.statics import rigid_motions, static_solution
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
UP = HalfSpace(point=(0.0, 0.0, 3.0), normal=(0.0, 0.0, -1.0))  # the upper end of the column
STATIC = Solver("newmark")


@pytest.fixture(scope="module")
def column(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 1, 3), np.linspace(0, 1, 3), np.linspace(0, 3, 5), jitter=0.2)


def pulled(mesh: TetMesh, history: History | None = None) -> Scene:
    """A column on rollers, pulled up with a hundredth of Young's modulus."""
    rollers = FixedComponents(mesh.nodes == 0)
    pull = Traction(UP, (0.0, 0.0, 50.0), history=History() if history is None else history)
    return Scene(Geometry(), {"rollers": rollers, "pull": pull}, Material(5e3, 0.4, 1.0), Recording(0.1, 3), STATIC)


def stretched(mesh: TetMesh) -> np.ndarray:
    """Uniaxial stress: sigma / E along z, -nu sigma / E across."""
    return mesh.nodes * np.array([-0.004, -0.004, 0.01])


def test_a_pulled_column_stretches_by_stress_over_youngs_modulus(column: TetMesh) -> None:
    found = static_solution(plan(pulled(column), column))
    np.testing.assert_allclose(found, stretched(column), rtol=0, atol=1e-12)  # linear elements hold a constant strain


def test_large_solids_are_solved_iteratively_to_the_same_answer(column: TetMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = static_solution(plan(pulled(column), column))
    monkeypatch.setattr(statics, "DIRECT_SIZE", 10)
    iterated = static_solution(plan(pulled(column), column))
    assert (iterated != direct).any()
    np.testing.assert_allclose(iterated, direct, rtol=0, atol=1e-11 * np.abs(direct).max())


def test_a_load_over_time_counts_with_its_last_value(column: TetMesh) -> None:
    found = static_solution(plan(pulled(column, History((0.0, 0.1, 0.3), (5.0, -2.0, 0.5))), column))
    np.testing.assert_allclose(found, 0.5 * stretched(column), rtol=0, atol=1e-12)


def test_a_damped_motion_ends_in_the_static_solution(column: TetMesh) -> None:
    scene = pulled(column, ramp(0.05))
    damped = replace(scene, effects=scene.effects | {"damping": RayleighDamping(mass=60.0, stiffness=2e-3)}, recording=Recording(1.0, 9))
    end = simulate(damped, column).displacements[-1]
    np.testing.assert_allclose(end, static_solution(plan(scene, column)), rtol=0, atol=1e-6 * np.abs(end).max())


def test_each_load_case_has_a_row(column: TetMesh) -> None:
    scene = pulled(column)
    cases: dict[str, Effect] = {"weight": BodyForce((0.0, 0.0, -3.0)), "push": Traction(UP, (0.0, 0.0, -50.0))}
    found = static_solution(plan(replace(scene, load_cases=cases), column))
    assert found.shape == (2, *column.nodes.shape)
    alone = static_solution(plan(replace(scene, effects=scene.effects | {"weight": cases["weight"]}), column))
    np.testing.assert_allclose(found[0], alone, rtol=0, atol=1e-12 * np.abs(alone).max())
    np.testing.assert_allclose(found[1], 0, atol=1e-12)  # the push takes the pull away


def test_nothing_but_elastic_force_and_load_matters(column: TetMesh) -> None:
    plain = static_solution(plan(pulled(column), column))
    for solver in (Solver("leapfrog"), Solver("symplectic_euler", "consistent"), Solver("modal", modes=3)):
        np.testing.assert_array_equal(static_solution(plan(replace(pulled(column), solver=solver), column)), plain)


def _held(mesh: TetMesh, *held: tuple[int, int]) -> dict[str, Effect]:
    mask = np.zeros(mesh.nodes.shape, dtype=np.bool_)
    for node, component in held:
        mask[node, component] = True
    return {"held": FixedComponents(mask)} if held else {}


CORNERS = ((0, 0), (0, 1), (0, 2))  # of the first node


@pytest.mark.parametrize(("held", "rank"), [((), 0), (CORNERS, 3), ((*CORNERS, (1, 0), (1, 1)), 5)])
def test_a_solid_that_can_move_without_a_force_is_refused(held: tuple[tuple[int, int], ...], rank: int) -> None:
    tet = TetMesh(np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([[0, 2, 3, 1]]))
    scene = Scene(Geometry(), {"weight": BodyForce((0.0, 0.0, -1.0)), **_held(tet, *held)}, solver=STATIC)
    with pytest.raises(PhysicsError, match=f"found the solid held against {rank}; pin three nodes that are not in a row, or simulate the free motion instead"):
        static_solution(plan(scene, tet))


def test_six_well_chosen_components_are_enough() -> None:
    tet = TetMesh(np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([[0, 2, 3, 1]]))
    scene = Scene(Geometry(), {"weight": BodyForce((0.0, 0.0, -1.0)), **_held(tet, *CORNERS, (1, 0), (1, 1), (2, 1))}, solver=STATIC)
    assert np.isfinite(static_solution(plan(scene, tet))).all()


def test_three_nodes_in_a_row_do_not_hold_a_solid(column: TetMesh) -> None:
    in_a_row = [int(np.flatnonzero((np.abs(column.nodes - [0, 0, z]) < 1e-12).all(axis=1))[0]) for z in (0.0, 1.5, 3.0)]
    scene = Scene(Geometry(), {"weight": BodyForce((0.0, 0.0, -1.0)), **_held(column, *((node, k) for node in in_a_row for k in range(3)))}, solver=STATIC)
    with pytest.raises(PhysicsError, match="held against 5"):
        static_solution(plan(scene, column))


def test_a_loose_part_beside_a_held_one_is_named(make_box: MakeBox) -> None:
    one, other = make_box([0, 1], [0, 1], [0, 1]), make_box([5, 6], [0, 1], [0, 1])
    both = TetMesh(np.concatenate([one.nodes, other.nodes]), np.concatenate([one.tets, other.tets + len(one.nodes)]))
    wall = Pinned(HalfSpace(normal=(1.0, 0.0, 0.0)))
    with pytest.raises(PhysicsError, match="found part 2 of 2, 8 nodes with node 8 among them, held against 0"):
        static_solution(plan(Scene(Geometry(), {"wall": wall, "weight": BodyForce((0.0, 0.0, -1.0))}, solver=STATIC), both))


@pytest.mark.parametrize("direct_size", [0, 10_000])
def test_a_part_that_hangs_on_one_node_is_no_solution(make_box: MakeBox, monkeypatch: pytest.MonkeyPatch, direct_size: int) -> None:
    one, other = make_box([0, 1, 2], [0, 1], [0, 1]), make_box([2, 3, 4], [1, 2], [1, 2])
    shared = int(np.flatnonzero((one.nodes == [2, 1, 1]).all(axis=1))[0])
    joint = int(np.flatnonzero((other.nodes == [2, 1, 1]).all(axis=1))[0])
    numbers = np.where(np.arange(len(other.nodes)) > joint, np.arange(len(other.nodes)) - 1, np.arange(len(other.nodes))) + len(one.nodes)
    numbers[joint] = shared
    hinged = TetMesh(np.concatenate([one.nodes, np.delete(other.nodes, joint, axis=0)]), np.concatenate([one.tets, numbers[other.tets]]))
    monkeypatch.setattr(statics, "DIRECT_SIZE", direct_size)
    wall = Pinned(HalfSpace(normal=(1.0, 0.0, 0.0)))
    with pytest.raises(PhysicsError, match="elastic force and load must balance to 0.0001, found .*: a part of the solid hangs on an edge or a node alone"):
        static_solution(plan(Scene(Geometry(), {"wall": wall, "weight": BodyForce((0.0, 0.0, -1.0))}, solver=STATIC), hinged))


def test_forces_that_follow_the_state_are_refused(column: TetMesh, on_springs: type[Effect]) -> None:
    scene = pulled(column)
    scene = replace(scene, effects=scene.effects | {"springs": on_springs()}, solver=Solver("leapfrog"))
    with pytest.raises(ConfigurationError, match="a static solution needs a linear scene, found the force law of 'springs'; remove that effect"):
        static_solution(plan(scene, column))


def test_rigid_motions_are_six_without_strain(column: TetMesh) -> None:
    motions = rigid_motions(column.nodes)
    assert np.linalg.matrix_rank(motions.reshape(6, -1)) == 6
    edges = column.nodes[column.tets[:, 1:]] - column.nodes[column.tets[:, :1]]
    for motion in motions:
        stretch = (motion[column.tets[:, 1:]] - motion[column.tets[:, :1]]) * edges
        np.testing.assert_allclose(stretch.sum(axis=2), 0, atol=1e-14)  # every edge keeps its length
