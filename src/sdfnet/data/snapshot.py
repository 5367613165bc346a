"""Snapshots of a long simulation on disk, so that a killed one goes on bit for bit."""

import logging
import time
from pathlib import Path

import torch

from sdfnet.data.store import known_file, new_file
from sdfnet.errors import StoreError
from sdfnet.physics.integrators.integrator import State
from sdfnet.physics.plan import Plan
from sdfnet.physics.simulate import Progress, Snapshot, run
from sdfnet.physics.trajectory import Trajectory

logger = logging.getLogger(__name__)

SECONDS_BETWEEN = 60.0  # a run that is over sooner never writes one


def run_resumably(compiled: Plan, path: Path, progress: Progress | None = None, seconds_between: float = SECONDS_BETWEEN) -> Trajectory:
    """Run a plan, going on from the snapshot at `path` if there is one, and writing one there from time to time.

    `path` is deleted at the end. A snapshot that cannot be read, or is of another plan, is passed over with
    a warning. Raises SimulationStopped as `run` does, and StoreError when a snapshot cannot be written.
    """
    written = time.monotonic()

    def keep(snapshot: Snapshot) -> None:
        nonlocal written
        if time.monotonic() - written >= seconds_between:
            write_snapshot(path, snapshot)
            written = time.monotonic()

    resume = None
    if path.is_file():
        try:
            found = read_snapshot(path)
            if found.fingerprint != compiled.fingerprint():
                raise StoreError(f"'{path}' must be a snapshot of this plan, found one of another scene, mesh or step")
            resume = found
            logger.info("simulation goes on from frame %d", resume.displacements.shape[1] - 1)
        except StoreError as error:
            logger.warning("%s; the simulation begins anew", error)
    trajectory = run(compiled, progress, resume=resume, keep=keep)
    path.unlink(missing_ok=True)
    return trajectory


def write_snapshot(path: Path, snapshot: Snapshot) -> None:
    """Write a snapshot as HDF5, whole or not at all. Raises StoreError."""
    state = snapshot.state
    with new_file(path, "snapshot", {}, snapshot.displacements.nbytes) as file:
        file["displacements"] = snapshot.displacements
        file["displacement"], file["velocity"] = state.displacement.cpu().numpy(), state.velocity.cpu().numpy()
        file.attrs["step"], file.attrs["plan"] = state.step, snapshot.fingerprint
        for group, values in (("work", state.work), ("own", state.own)):
            for name, value in values.items():
                file[f"{group}/{name}"] = value.cpu().numpy()
        for name, numbers in snapshot.watch.items():
            file[f"watch/{name}"] = numbers


def read_snapshot(path: Path) -> Snapshot:
    """Read what `write_snapshot` wrote. Raises StoreError."""
    with known_file(path, "snapshot") as file:
        work, own = ({name: torch.from_numpy(values[()]) for name, values in file.get(group, {}).items()} for group in ("work", "own"))
        displacement, velocity = (torch.from_numpy(file[name][:]) for name in ("displacement", "velocity"))
        state = State(displacement, velocity, int(file.attrs["step"]), work, own)
        watch = {name: values[:] for name, values in file["watch"].items()}
        return Snapshot(file["displacements"][:], state, watch, str(file.attrs.get("plan", "")))
