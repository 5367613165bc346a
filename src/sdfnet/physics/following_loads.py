"""Steps short enough to follow the loads that change with time."""

import logging

import numpy as np

from sdfnet.physics.demands import Demands
from sdfnet.physics.effects.history import History
from sdfnet.scene import Scene

logger = logging.getLogger(__name__)

LARGEST_MISS = 0.1  # of a load's strength, where it bends: a rise of three steps at worst, a half sine of eight, a triangle of ten
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
            finer = count
            while load.history.largest_miss(duration / (finer * intervals), duration) > LARGEST_MISS and finer * intervals <= MOST_STEPS_TO_FOLLOW:
                finer *= 2
            if count < finer <= MOST_STEPS_TO_FOLLOW / intervals:
                count, shortened_for = finer, name
    for name, load in loads.items():
        _warn_if_missed(name, load.history, duration / (count * intervals), duration, has_laws=bool(demands.laws))
    return count, shortened_for


def _warn_if_missed(name: str, history: History, time_step: float, duration: float, has_laws: bool) -> None:
    missed = history.largest_miss(time_step, duration)
    if missed <= LARGEST_MISS:
        return
    finer = time_step
    while history.largest_miss(finer, duration) > LARGEST_MISS and finer > np.spacing(duration):
        finer /= 2
    logger.warning(
        "the load '%s' over time changes within a step of %.4g s: lines between the steps miss it by up to %.2g %% of its strength, "
        "and should by %g %% at most. Its impulse is kept, but comes up to a step early or late; set solver.time_step=%.2g%s",
        name,
        time_step,
        100 * missed,
        100 * LARGEST_MISS,
        finer,
        "" if has_laws else ", or solver.integrator=modal or exact, which follow any load",
    )
