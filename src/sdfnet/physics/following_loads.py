"""Steps short enough to follow the loads that change with time."""

from sdfnet.errors import PhysicsError
from sdfnet.physics.demands import Demands
from sdfnet.scene import Scene

LARGEST_MISS = 0.1  # share of a load over time that steps may pass over: a half sine of three steps, or a triangle of four
MOST_STEPS = 10**8  # that a load over time may call for: hours even on a small solid


def following_loads(scene: Scene, demands: Demands, count: int) -> tuple[int, str]:
    """As many steps per frame as the loads over time need, and which of them needs more than `count`. Raises PhysicsError when the step is a given one."""
    duration, shortened_for = scene.recording.duration, ""
    for name, load in (demands.loads | demands.case_loads).items():
        while (missed := load.history.missed_share(duration / (count * (scene.recording.frames - 1)), duration)) > LARGEST_MISS:
            if scene.solver.time_step != "auto":
                raise PhysicsError(
                    f"time step {duration / (count * (scene.recording.frames - 1)):.4g} s passes over {100 * missed:.2g} % of the load '{name}' over time, "
                    f"more than {100 * LARGEST_MISS:g} %; lower solver.time_step or set it to auto"
                )
            count, shortened_for = 2 * count, name
            require_bearable(float(count * (scene.recording.frames - 1)), name)
    return count, shortened_for


def require_bearable(steps: float, name: str) -> None:
    """Raise PhysicsError when a load over time needs more steps than anybody waits for."""
    if steps > MOST_STEPS:
        raise PhysicsError(f"the load '{name}' over time needs {steps:.2g} steps or more, allowed are {MOST_STEPS:.0e}; let it change more slowly")
