"""Where a solid comes to rest under its loads."""

import logging

import numpy as np
from jaxtyping import Float64
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg, splu

from sdfnet.checked import taken
from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.physics.plan import Plan

logger = logging.getLogger(__name__)

DIRECT_SIZE = 5000  # unknowns up to which the sparse factor is the faster: its fill grows, on a solid of 14,000 it takes ten times as long as the iteration
RESIDUAL = 1e-12  # ||K u - f|| / ||f|| at which the iteration stops
LARGEST_RESIDUAL = 1e-4  # a solve that ends above it had a matrix that is singular in all but rounding
RIGID_ROUNDING = 1e-9  # singular values under this part of the largest are zero: three nodes in a row do not hold a solid against turning


def static_solution(compiled: Plan) -> Float64[np.ndarray, "*cases nodes 3"]:
    """The displacement (m) at which elastic force and loads balance: K u = f on the free components, u = 0 on the fixed ones.

    A row is a node of `compiled.model.elements`; with load cases the first axis counts them. Loads that change with time
    count with their last value, so that the result is where a damped motion ends. What sets the solid in motion,
    damping, and the mass do not matter. A scene of arrays needs no dataset file:

        cells = Box(size=(10.0, 1.0, 1.0), cells=(20, 2, 2))
        effects = {"wall": Pinned(HalfSpace(normal=(1.0, 0.0, 0.0))), "push": NodalForce(force)}
        u = static_solution(plan(Scene(cells, effects, solver=Solver("newmark", element="P2")), cells.tet_mesh()))

    Raises PhysicsError when a part of the solid can move without a force, and when the solve fails; ConfigurationError
    for force laws. Not for loads that deform the solid strongly, where it no longer is a linear problem.
    """
    require_linear(compiled, "a static solution")
    _require_held(compiled)
    motion = compiled.equation()
    force = motion.constant_force + sum((load.history.values[-1] * load.force for load in motion.timed_loads), np.zeros_like(motion.constant_force))
    solve = _directly if len(motion.free) <= DIRECT_SIZE else _iteratively
    solution = solve(motion.stiffness, force)
    _require_solved(motion, solution, force)
    nodal = np.zeros((force.shape[1], 3 * motion.n_nodes))
    nodal[:, motion.free] = solution.T
    cases = len(compiled.demands.case_loads)
    return nodal.reshape(*([cases] if cases else []), motion.n_nodes, 3)


def require_linear(compiled: Plan, wanted: str) -> None:
    """Raise ConfigurationError when forces follow the state, so that no matrix describes the solid."""
    if taken("what is solved, which plan(scene, mesh) makes,", compiled, Plan).demands.laws:
        raise ConfigurationError(f"{wanted} needs a linear scene, found the force law of '{next(iter(compiled.demands.laws))}'; remove that effect")


def _require_held(compiled: Plan) -> None:
    """Raise PhysicsError when a connected part of the solid can be moved as a rigid body with all fixed components at rest."""
    elements = compiled.model.elements
    count = int(elements.part_of.max()) + 1
    for part in range(count):
        nodes = np.flatnonzero(elements.part_of == part)
        held = compiled.fixed[nodes].ravel()
        motions = rigid_motions(elements.nodes[nodes]).reshape(6, -1)
        strengths = np.linalg.svd(motions[:, held], compute_uv=False) if held.any() else np.zeros(6)
        rank = int((strengths > RIGID_ROUNDING * np.linalg.norm(motions, axis=1).max()).sum())
        if rank < 6:
            which = "the solid" if count == 1 else f"part {part + 1} of {count}, {len(nodes)} nodes with node {nodes[0]} among them,"
            raise PhysicsError(
                f"a static solution needs every part of the solid held against all six rigid motions, found {which} held against {rank}; "
                "pin three nodes that are not in a row, or simulate the free motion instead"
            )


def rigid_motions(nodes: Float64[np.ndarray, "nodes 3"]) -> Float64[np.ndarray, "6 nodes 3"]:
    """Displacements without strain: unit translations along x, y, z, and small turns about them that move the outermost node by its lever's part of 1."""
    centred = nodes - nodes.mean(axis=0)
    reach = float(np.abs(centred).max())
    axes = np.eye(3)
    return np.stack([*(np.broadcast_to(axis, nodes.shape) for axis in axes), *(np.cross(axis, centred / reach) for axis in axes)])


def _directly(stiffness: csr_matrix, force: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
    try:
        factor = splu(stiffness.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # an exact zero on the diagonal
        return np.full_like(force, np.nan)
    result: np.ndarray = factor.solve(force)
    return result


def _iteratively(stiffness: csr_matrix, force: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
    """Conjugate gradients, each unknown scaled by its own stiffness."""
    scale = diags(1 / stiffness.diagonal())
    solved = [cg(stiffness, column, rtol=RESIDUAL, M=scale) for column in force.T]
    return np.stack([solution for solution, _ in solved], axis=1)


def _require_solved(motion: EquationOfMotion, solution: Float64[np.ndarray, "dofs columns"], force: Float64[np.ndarray, "dofs columns"]) -> None:
    missing = np.linalg.norm(motion.stiffness @ solution - force, axis=0)
    sizes = np.linalg.norm(force, axis=0)
    worst = float(np.max(np.divide(missing, sizes, out=np.zeros_like(missing), where=sizes > 0)))
    logger.debug("static solution of %d unknowns, residual %.2g", len(solution), worst)
    if not (np.isfinite(solution).all() and worst <= LARGEST_RESIDUAL):
        raise PhysicsError(
            f"elastic force and load must balance to {LARGEST_RESIDUAL:g}, found {worst:.3g}: a part of the solid hangs on an edge or a node alone, "
            "or the mesh has extreme slivers; mend the mesh or hold more of it"
        )
