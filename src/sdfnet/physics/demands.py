"""What the effects of a scene ask of the simulator, gathered role by role."""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.physics.effects.roles import (
    AddsDamping,
    AddsLoad,
    ChangesMaterial,
    ConstrainsNodes,
    Damping,
    FollowsState,
    ForceLaw,
    Load,
    ReplacesElasticity,
    Report,
    SetsStart,
    Start,
)
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.scene import Effect, Scene

logger = logging.getLogger(__name__)


@dataclass(eq=False)
class Demands:
    """All that a scene's effects ask for. What none asks for is empty; what comes to zero is as if it were not there."""

    fixed: Bool[np.ndarray, "nodes 3"]  # components that do not move
    start: Start
    loads: dict[str, Load]  # by the effect's name
    case_loads: dict[str, Load]  # by the load case's name; each acts alone, beside the loads
    laws: dict[str, ForceLaw]  # by the effect's name
    damping: Damping
    replaces_elasticity: bool
    lines: list[str]  # one for each effect: its name, type and what it does here
    case_lines: list[str]  # the same for each load case
    report: Report

    @property
    def stress(self) -> float:
        """The stress to expect, Pa: the sum of the loads' at their strongest, and the largest load case's."""
        cases = [load.stress * max(map(abs, load.history.values)) for load in self.case_loads.values()]
        return sum(load.stress * max(map(abs, load.history.values)) for load in self.loads.values()) + max(cases, default=0.0)

    @property
    def added_stiffness(self) -> Float64[np.ndarray, " nodes"]:
        """Of all force laws, N/m."""
        return sum((law.added_stiffness() for law in self.laws.values()), np.zeros(len(self.fixed)))

    @property
    def stable_fraction(self) -> float:
        """The smallest of the force laws'."""
        return min((law.stable_fraction for law in self.laws.values()), default=1.0)

    @property
    def moves(self) -> bool:
        """Whether anything sets the solid in motion."""
        follows = any(law.is_driven for law in self.laws.values())
        return bool(self.loads or self.case_loads or follows or self.start.displacement.any() or self.start.velocity.any())


def demands_of(scene: Scene, model: ElasticModel) -> Demands:
    """Ask every effect for what its roles promise. Raises ConfigurationError or PhysicsError for what cannot be."""
    shape = model.elements.nodes.shape
    demands = Demands(np.zeros(shape, dtype=np.bool_), Start(np.zeros(shape), np.zeros(shape)), {}, {}, {}, Damping(), False, [], [], {})
    deeds: dict[str, list[str]] = {name: [] for name in scene.effects}
    for role, ask in _ROLES.items():  # role by role: what is held must be known before contact asks for it
        for name, effect in scene.effects.items():
            if isinstance(effect, role):
                deeds[name].append(ask(demands, name, effect, model))
    for name, effect in scene.effects.items():
        if not deeds[name]:
            raise ConfigurationError(
                f"effect '{name}' ({type(effect).__name__}) asks nothing of the simulator; derive it from a role in sdfnet.physics.effects.roles"
            )
        demands.lines.append(f"{name}: {type(effect).__name__} {' and '.join(deeds[name])}")
    if demands.replaces_elasticity and demands.damping.stiffness:
        raise ConfigurationError(
            "stiffness-proportional damping belongs to the linear elastic force, which another effect replaces here; use the mass-proportional part"
        )
    stresses = [name for name, load in demands.loads.items() if load.is_stress]
    if demands.replaces_elasticity and stresses:
        raise ConfigurationError(f"'{stresses[0]}' is a strain of the linear elastic force, which another effect replaces here; remove one of the two")
    _add_cases(demands, scene, model)
    _check_that_something_can_move(demands)
    _hold_the_fixed(demands)
    return demands


def _include(_: Demands, __: str, effect: ChangesMaterial, model: ElasticModel) -> str:
    material = effect.material
    return (
        f"makes {int(effect.tets(model.mesh).sum())} tets of another material (Young's modulus {material.youngs_modulus:.4g} Pa, "
        f"Poisson ratio {material.poisson_ratio:.4g}, density {material.density:.4g} kg/m^3)"
    )


def _constrain(demands: Demands, _: str, effect: ConstrainsNodes, model: ElasticModel) -> str:
    held = effect.fixed_components(model.elements)
    demands.fixed |= held
    return f"fixes {int(held.sum())} components of {int(held.any(axis=1).sum())} nodes"


def _load(demands: Demands, name: str, effect: AddsLoad, model: ElasticModel) -> str:
    load = effect.load(model)
    demands.report.update({f"{name}_{key}": value for key, value in load.report.items()})
    if not load.nodal_force.any() or not any(load.history.values):
        return "adds a load of nothing, which is left out"
    demands.loads[name] = load
    return _adds(load)


def _adds(load: Load) -> str:
    """What a load does, in words."""
    kind = "constant load" if load.history.is_constant else f"load over time from {load.history.times[0]:g} to {load.history.times[-1]:g} s"
    return f"adds a {kind} ({', '.join(f'{key} {_short(value)}' for key, value in load.report.items())})"


def _damp(demands: Demands, _: str, effect: AddsDamping, model: ElasticModel) -> str:
    damping = effect.damping(model)
    demands.damping = demands.damping + damping
    return f"damps with C = {damping.mass:g}/s M + {damping.stiffness:g} s K" if damping else "damps with nothing, which is left out"


def _start(demands: Demands, _: str, effect: SetsStart, model: ElasticModel) -> str:
    start = effect.start(model)
    if not (start.displacement.any() or start.velocity.any()):
        return "starts the solid at rest, which is left out"
    demands.start.displacement[:] += start.displacement
    demands.start.velocity[:] += start.velocity
    fastest, farthest = (float(np.linalg.norm(values, axis=1).max()) for values in (start.velocity, start.displacement))
    return f"starts the solid with {fastest:.4g} m/s and {farthest:.4g} m at most"


def _follow(demands: Demands, name: str, effect: FollowsState, model: ElasticModel) -> str:
    law = effect.force_law(model, demands.fixed)
    if law is None:
        return "comes to nothing, which is left out"
    demands.laws[name] = law
    return "needs a new force at every step"


def _replace(demands: Demands, name: str, effect: ReplacesElasticity, model: ElasticModel) -> str:
    if demands.replaces_elasticity:
        raise ConfigurationError(f"only one effect may replace the linear elastic force, found '{name}' beside another; remove one")
    demands.replaces_elasticity = True
    demands.laws[name] = effect.elastic_law(model)
    return "takes the place of the linear elastic force, and is computed at every step"


_ROLES: dict[type[Effect], Callable[..., str]] = {
    ChangesMaterial: _include,
    ConstrainsNodes: _constrain,
    AddsLoad: _load,
    AddsDamping: _damp,
    SetsStart: _start,
    FollowsState: _follow,
    ReplacesElasticity: _replace,
}


def _add_cases(demands: Demands, scene: Scene, model: ElasticModel) -> None:
    for name, effect in scene.load_cases.items():
        if name in scene.effects:
            raise ConfigurationError(f"load case '{name}' has the name of an effect, and what the two report would be mixed up; rename one")
        if not isinstance(effect, AddsLoad):
            raise ConfigurationError(f"load case '{name}' must be an effect that adds a load, found {type(effect).__name__}; put it among scene.effects")
        load = effect.load(model)
        demands.report.update({f"{name}_{key}": value for key, value in load.report.items()})
        demands.case_loads[name] = load
        demands.case_lines.append(f"{name}: {type(effect).__name__} {_adds(load)}")
    if scene.load_cases and demands.laws:
        raise ConfigurationError(f"load cases in one run need a linear scene, found '{next(iter(demands.laws))}'; simulate the cases one by one")


def _check_that_something_can_move(demands: Demands) -> None:
    if demands.fixed.all():
        raise PhysicsError("the effects must leave something free to move, found every component of every node fixed; pin less")
    for name, load in (demands.loads | demands.case_loads).items():
        if load.nodal_force.any() and not load.nodal_force[~demands.fixed].any():
            raise PhysicsError(f"the load '{name}' must reach a node that is free to move, found it on fixed components only; move the load or pin less")


def _hold_the_fixed(demands: Demands) -> None:
    """Let what is fixed start at rest, and say what was asked of it."""
    asked = [np.where(demands.fixed, values, 0.0) for values in (demands.start.displacement, demands.start.velocity)]
    held = (asked[0] != 0) | (asked[1] != 0)
    if held.any():
        farthest, fastest = (float(np.abs(values).max()) for values in asked)
        logger.warning(
            "the scene starts %d fixed components of %d nodes with up to %.4g m and %.4g m/s: they stay where they are; start only what is free, or pin less",
            held.sum(),
            held.any(axis=1).sum(),
            farthest,
            fastest,
        )
        demands.start.displacement[demands.fixed] = 0.0
        demands.start.velocity[demands.fixed] = 0.0


def _short(value: float | int | str) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
