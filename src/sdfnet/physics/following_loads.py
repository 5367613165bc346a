"""Steps short enough to follow the loads that change with time."""

import logging

import numpy as np

from sdfnet.physics.demands import Demands
from sdfnet.physics.effects.history import History
from sdfnet.scene import Scene

logger = logging.getLogger(__name__)

LARGEST_MISS = 0.1  # of a load's strength, where it bends: a rise of three steps at worst, a half sine of eight, a triangle of ten
MOST_STEPS = 10**8  # of a run: hours of the smallest solid
MOST_STEPS_TO_FOLLOW = 10**5  # that auto takes to follow a load: one that is over sooner still is a jump or a blow, whose impulse any step keeps


def following_loads(scene: Scene, demands: Demands, count: int) -> tuple[int, str]:
    """As many steps per frame as the loads over time need, and which of them needs more than `count`.

    A given step stays, and so does auto's where a load asks for more than MOST_STEPS_TO_FOLLOW: both with a warning that measures
    what is missed.
    """
    duration, intervals, shortened_for = scene.recording.duration, scene.recording.frames - 1, ""
    loads = {name: load for name, load in (demands.loads | demands.case_loads).items() if not load.history.is_constant}
    if scene.solver.time_step == "auto":
        for name, load in loads.items():
            step = duration / (count * intervals)
            finer = count * round(step / needed_step(load.history, step, duration))
            if count < finer <= MOST_STEPS_TO_FOLLOW / intervals:
                count, shortened_for = finer, name
    step = duration / (count * intervals)
    for name, load in loads.items():
        missed = load.history.largest_miss(step, duration)
        if missed > LARGEST_MISS:
            logger.warning(
                "the load '%s' over time changes within a step of %.4g s: lines between the steps miss it by up to %.2g %% of its strength, "
                "and should by %g %% at most. Its impulse is kept, but comes up to a step early or late; %s",
                name,
                step,
                100 * missed,
                100 * LARGEST_MISS,
                _cure(scene, demands, needed_step(load.history, step, duration)),
            )
    return count, shortened_for


def needed_step(history: History, step: float, duration: float) -> float:
    """The step (s), halved until lines between the steps miss the load by LARGEST_MISS of its strength at most, or time cannot be told apart."""
    while history.largest_miss(step, duration) > LARGEST_MISS and step > np.spacing(duration):
        step /= 2
    return step


def _cure(scene: Scene, demands: Demands, step: float) -> str:
    """What a user may set: a step of that length where a run can take so many, and a method that follows any load where there is one."""
    cures = []
    if scene.recording.duration / step <= MOST_STEPS:
        cures.append(f"solver.time_step={step:.10g}")  # no rounder: the step that was checked, not one beside it whose ends may lie worse
    if not demands.laws:
        takes_exact = scene.solver.mass == "lumped" and not demands.damping
        all_modes = f"modal with all modes (solver.modes={int((~demands.fixed).sum())}, for small meshes)"
        cures.append(f"solver.integrator={'exact' if takes_exact else all_modes}, which follows any load")
    return f"set {', or '.join(cures)}" if cures else "give it a longer history if more than the impulse matters"
