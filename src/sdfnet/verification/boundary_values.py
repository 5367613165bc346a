"""Static solutions with a given displacement on a part of the nodes: how exact solutions are tested that no pin can hold."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.demands import demands_of
from sdfnet.physics.effects.arrays import FixedComponents, NodalForce
from sdfnet.physics.elasticity import Field, finite_elements
from sdfnet.physics.plan import plan
from sdfnet.physics.statics import static_solution
from sdfnet.scene import Effect, Geometry, Material, Scene, Solver
from sdfnet.verification.row import deviation


def solution_with_given(
    mesh: TetMesh,
    material: Material,
    element: str,
    given: Float64[np.ndarray, "nodes 3"],
    is_given: Bool[np.ndarray, "nodes 3"],
    load: Effect | None = None,
) -> Float64[np.ndarray, "nodes 3"]:
    """The displacement (m) under a load when the components where `is_given` are put to `given` (m).

    With u = w + b, b the given components and zero elsewhere, K w = f - K b is a scene that holds these components.
    """
    placed = np.where(is_given, given, 0.0)
    effects: dict[str, Effect] = {"given": FixedComponents(is_given)} | ({} if load is None else {"load": load})
    scene = Scene(Geometry(), effects, material, solver=Solver("newmark", element=element))
    held = plan(scene, mesh)
    pull = NodalForce(-(held.model.stiffness @ placed.ravel()).reshape(-1, 3))
    pulled = replace(scene, effects=effects | {"pull": pull})
    return placed + static_solution(replace(held, scene=pulled, demands=demands_of(pulled, held.model)))


def boundary_value_error(mesh: TetMesh, material: Material, element: str, exact: Field, load: Effect | None = None) -> float:
    """The largest error inside, over the largest displacement, when the boundary's nodes are put where `exact` has them."""
    elements = finite_elements(mesh, element)
    everywhere = exact(elements.nodes)
    is_given = np.repeat(elements.is_on_boundary[:, None], 3, axis=1)
    return deviation(solution_with_given(mesh, material, element, everywhere, is_given, load), everywhere)
