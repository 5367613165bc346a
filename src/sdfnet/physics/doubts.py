"""What is doubtful about a scene that is run as asked, and what to do about it."""

import numpy as np

from sdfnet.geometry.surface import place_text
from sdfnet.physics.demands import Demands
from sdfnet.physics.effects.roles import FollowsState
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.scene import Material, Scene

LARGEST_LINEAR_STRAIN = 0.1  # linear elasticity drops terms of the strain squared: above this they are ten percent of it
LOCKING_POISSON_RATIO = {"P1": 0.45, "P1_nodal_pressure": 0.5, "P2": 0.499}  # above it the element is visibly too stiff
PARTS_NAMED = 3  # of those that nothing holds, the largest first, so that a message can be read
NOTHING_MOVES = "nothing loads the solid or moves it: every frame will be the rest state"  # of steps alone: modes and statics need no load


def doubts(scene: Scene, model: ElasticModel, demands: Demands) -> list[str]:
    """A sentence for each: elements that lock, loads outside linear elasticity, a solid or a part of it that nothing holds."""
    return [*_locking(scene, model), *_large_strain(model, demands), *_loose(scene, model, demands)]


def _locking(scene: Scene, model: ElasticModel) -> list[str]:
    element, poisson_ratio = scene.solver.element, float(np.max(model.material.poisson_ratio))
    if poisson_ratio <= LOCKING_POISSON_RATIO[element]:
        return []
    kind, cure = "linear" if element == "P1" else "quadratic", "set solver.element=P1_nodal_pressure"
    if element == "P2":  # the other element would cost more in bending than it cures here
        cure = "lower the Poisson ratio, or compare with a finer mesh"
    elif not isinstance(model.material, Material):  # which that element refuses
        cure = "set solver.element=P2"
    limit = LOCKING_POISSON_RATIO[element]
    return [f"Poisson ratio {poisson_ratio:.5g} > {limit:.3g}: {kind} tets lock and the solid will look too stiff; {cure}"]


def _large_strain(model: ElasticModel, demands: Demands) -> list[str]:
    strain = demands.stress / float(np.min(model.material.youngs_modulus))
    if strain <= LARGEST_LINEAR_STRAIN or demands.replaces_elasticity:
        return []
    return [
        f"outside linear elasticity: the load is {strain:.2g} of Young's modulus, valid up to about {LARGEST_LINEAR_STRAIN:.2g}; "
        "it is run as asked (the paper's own scene has 0.8)"
    ]


def _loose(scene: Scene, model: ElasticModel, demands: Demands) -> list[str]:
    """The solid, or those of its unconnected parts that nothing holds: neither thrown, nor over a floor to rest on."""
    if not demands.fixed.any():
        return ["nothing holds the solid: it flies freely"]
    elements = model.elements
    moves = demands.start.velocity.any(axis=1) | demands.start.displacement.any(axis=1)
    settled = np.bincount(elements.part_of, demands.fixed.any(axis=1) | moves) > 0
    rests = any(isinstance(scene.effects[name], FollowsState) and not law.is_driven for name, law in demands.laws.items())
    if settled.all() or rests:
        return []
    sizes = np.where(settled, 0, np.bincount(elements.part_of[elements.tets[:, 0]], minlength=len(settled)))
    count = int((~settled).sum())
    largest = np.argsort(-sizes, kind="stable")[: min(PARTS_NAMED, count)]
    places = [place_text(elements.nodes[elements.part_of == part].mean(axis=0)) for part in largest]
    named = ", ".join(f"part {part + 1} of {sizes[part]} tets about {place} m" for part, place in zip(largest, places, strict=True))
    verb, them, such_as = ("is", "it", ": ") if count == 1 else ("are", "them", ", such as " if count > PARTS_NAMED else ": ")
    return [
        f"{count} of the {len(settled)} unconnected parts of the mesh {verb} held by nothing, and any load makes {them} fly freely{such_as}{named}; "
        "pin each by itself, join it to the rest, or leave it out of the mesh"
    ]
