"""What is simulated and how it is sampled: frozen settings with units, and nothing that runs.

A dataset plugin returns a `Dataset`; the object is its own configuration. `Geometry` and `Effect` are the two open
sets: a class derived from either, in any file, is a new kind of solid or a new thing that acts on it.
"""

import math
from dataclasses import dataclass, field

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError

SOLVER_CHOICES = {
    "integrator": ("leapfrog", "symplectic_euler", "newmark", "modal", "exact"),
    "mass": ("lumped", "consistent"),
    "element": ("P1", "P1_nodal_pressure", "P2"),
}


@dataclass(frozen=True)
class Geometry(Checked):
    """A solid at rest. Derived classes say how it is made; `sdfnet.geometry` holds those that come with sdfnet."""


@dataclass(frozen=True)
class Effect(Checked):
    """One thing that acts on the solid. What it needs from the simulator is said by the roles that it derives from."""


@dataclass(frozen=True)
class Material(Checked):
    """Isotropic linear elastic material (paper section 2)."""

    youngs_modulus: float = 5e3  # Pa
    poisson_ratio: float = 0.40
    density: float = 1.0  # kg/m^3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("youngs_modulus", "density"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigurationError(f"material.{name} must be positive and finite, found {value}")
        if not -1.0 < self.poisson_ratio < 0.5:
            raise ConfigurationError(
                f"material.poisson_ratio must lie in (-1, 0.5), found {self.poisson_ratio}; a solid that keeps its volume is approached with 0.49"
            )

    @property
    def lame_lambda(self) -> float:
        """First Lame parameter, Pa: E nu / ((1 + nu)(1 - 2 nu))."""
        return self.youngs_modulus * self.poisson_ratio / ((1 + self.poisson_ratio) * (1 - 2 * self.poisson_ratio))

    @property
    def lame_mu(self) -> float:
        """Second Lame parameter (shear modulus), Pa: E / (2 (1 + nu))."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def bulk_modulus(self) -> float:
        """K, Pa: E / (3 (1 - 2 nu))."""
        return self.youngs_modulus / (3 * (1 - 2 * self.poisson_ratio))

    @property
    def pressure_wave_speed(self) -> float:
        """Speed of sound, m/s: sqrt((lambda + 2 mu) / rho)."""
        return math.sqrt((self.lame_lambda + 2 * self.lame_mu) / self.density)


@dataclass(frozen=True)
class Recording(Checked):
    """Which times are saved: `frames` of them, evenly from 0 to `duration`, the rest state first."""

    duration: float = 0.01  # s
    frames: int = 101

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.duration) and self.duration > 0):
            raise ConfigurationError(f"recording.duration must be positive and finite, found {self.duration} s")
        if self.frames < 2:
            raise ConfigurationError(f"recording.frames must be at least 2 (the rest state and one more), found {self.frames}")


@dataclass(frozen=True)
class Solver(Checked):
    """How the equation of motion is discretised in space and stepped through time."""

    integrator: str = "leapfrog"  # leapfrog: second order; symplectic_euler: the paper's; newmark, modal, exact: see sdfnet.physics.integrators
    mass: str = "lumped"  # lumped: no solve per step; consistent: the Galerkin form of the paper
    element: str = "P1"  # P1: linear tets, the paper's; P1_nodal_pressure: they do not lock near Poisson ratio 0.5; P2: quadratic
    time_step: float | int | str = "auto"  # s; auto: the true stability limit times safety, or a part of a frame where nothing limits it
    safety: float = 0.9  # fraction of the stability limit that auto takes
    modes: int = 100  # how many modal keeps

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, allowed in SOLVER_CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ConfigurationError(f"solver.{name} must be one of {', '.join(allowed)}; found '{getattr(self, name)}'")
        if isinstance(self.time_step, str):
            if self.time_step != "auto":
                raise ConfigurationError(f"solver.time_step must be 'auto' or seconds, found '{self.time_step}'")
        elif not (math.isfinite(self.time_step) and self.time_step > 0):
            raise ConfigurationError(f"solver.time_step must be positive and finite, found {self.time_step} s")
        if not 0 < self.safety < 1:
            raise ConfigurationError(f"solver.safety must lie in (0, 1), found {self.safety}")
        if self.modes < 1:
            raise ConfigurationError(f"solver.modes must be at least 1, found {self.modes}")


@dataclass(frozen=True)
class Scene(Checked):
    """A solid, its material, what acts on it, and which times are saved.

    With `load_cases`, each is a load that acts in turn beside the effects, all in one run: the shapes of all cases,
    one case after the other, are one family.
    """

    geometry: Geometry
    effects: dict[str, Effect]
    material: Material = field(default_factory=Material)
    recording: Recording = field(default_factory=Recording)
    solver: Solver = field(default_factory=Solver)
    load_cases: dict[str, Effect] = field(default_factory=dict)

    @property
    def frame_count(self) -> int:
        """Recorded frames of all load cases."""
        return self.recording.frames * max(1, len(self.load_cases))


@dataclass(frozen=True)
class Sampling(Checked):
    """Where the distance is asked for (paper section 3), and a second set of points close to the surface.

    The paper's set: `count` points in the largest frame box scaled by `box_scale`, z drawn with density
    a (z - z_min)^z_exponent + z_floor, then kept per frame with a chance that grows with the weight
    w (1 + |d|)^(-decay). The paper prints the exponent as +10 and says that it decays; -10 is the default here.
    """

    count: int = 1_000_000  # points before filtering
    box_scale: float = 1.5
    z_exponent: float = 0.5
    z_floor: float = 0.001
    weight_outside: float = 0.8
    weight_inside: float = 3.0
    decay: float = 10.0  # of the weight with distance in metres; negative: the paper's formula as printed
    kept_share: float = 0.39  # fraction of the points that the rest frame keeps; the paper kept 389,992 of 1,000,000
    near_surface_count: int = 300_000  # points drawn about the surfaces of random frames; 0: none, as in the paper
    near_surface_spread: float = 0.0085  # standard deviation of their offset, as a fraction of the rest diagonal
    broken_frames: str = "keep"  # keep: frames with inverted tets or crossing faces are marked and warned of; refuse: they are an error
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.broken_frames not in ("keep", "refuse"):
            raise ConfigurationError(f"sampling.broken_frames must be keep or refuse, found '{self.broken_frames}'")
        if self.count < 1 or self.near_surface_count < 0:
            raise ConfigurationError(f"sampling counts must be positive, found count={self.count}, near_surface_count={self.near_surface_count}")
        if not 0 < self.kept_share < 1:
            raise ConfigurationError(f"sampling.kept_share must lie in (0, 1), found {self.kept_share}")
        for name in ("weight_outside", "weight_inside", "near_surface_spread"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigurationError(f"sampling.{name} must be positive and finite, found {getattr(self, name)}")
        for name in ("z_exponent", "z_floor"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigurationError(f"sampling.{name} must be finite and not negative, found {getattr(self, name)}")
        if not math.isfinite(self.decay):
            raise ConfigurationError(f"sampling.decay must be finite, found {self.decay}")
        if not 1 < self.box_scale < math.inf:
            raise ConfigurationError(f"sampling.box_scale must exceed 1 and be finite, found {self.box_scale}")
        if self.seed < 0:  # NumPy takes no negative one
            raise ConfigurationError(f"sampling.seed must not be negative, found {self.seed}")


@dataclass(frozen=True)
class Dataset(Checked):
    """A named recipe: a scene and how its distances are sampled."""

    scene: Scene
    sampling: Sampling = field(default_factory=Sampling)
