"""Results do not depend on the units, nor on size, stiffness and density but as dimensional analysis says."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import plan
from sdfnet.physics.simulate import run
from sdfnet.physics.statics import static_solution
from sdfnet.physics.vibration import natural_frequencies
from sdfnet.scene import SOLVER_CHOICES, Effect, Geometry, Material, Recording, Scene, Solver
from sdfnet.verification.meshes import jittered_box
from sdfnet.verification.row import Row, absolute, deviation

AGREEMENT = 1e-10  # NUMERICS


@dataclass(frozen=True)
class Scale:
    """Factors on lengths, Young's modulus and density; time then has the factor length sqrt(density / modulus)."""

    length: float
    modulus: float
    density: float

    @property
    def time(self) -> float:
        """The factor on times."""
        return self.length * math.sqrt(self.density / self.modulus)


METRES = Scale(1.0, 1.0, 1.0)
SCALES = {
    "millimetres": Scale(1e3, 1e-3, 1e-9),  # kg / (mm s^2) and kg / mm^3 in place of Pa and kg / m^3
    "another solid": Scale(0.7, 3e7, 900.0),
}


def units() -> Iterator[Row]:
    """A poked block in metres, in millimetres, and as another solid of the same shape: static, ringing and moving."""
    for name, scale in SCALES.items():
        for element in SOLVER_CHOICES["element"]:
            metres, scaled = (_poked(Solver("newmark", "consistent", element), one) for one in (METRES, scale))
            found = deviation(static_solution(plan(*scaled)) / scale.length, static_solution(plan(*metres)))
            yield absolute(f"{name}, {element}", "static displacement over length", 0.0, found, AGREEMENT)
            found = deviation(natural_frequencies(plan(*scaled), 4).frequencies * scale.time, natural_frequencies(plan(*metres), 4).frequencies)
            yield absolute(f"{name}, {element}", "four frequencies in wave speed over length", 0.0, found, AGREEMENT)
        for integrator in INTEGRATORS:
            metres, scaled = (_poked(Solver(integrator), one) for one in (METRES, scale))
            found = deviation(run(plan(*scaled)).displacements / scale.length, run(plan(*metres)).displacements)
            yield absolute(f"{name}, {integrator}", "displacement over length, four frames", 0.0, found, AGREEMENT)


def _poked(solver: Solver, scale: Scale) -> tuple[Scene, TetMesh]:
    """A block of 20 x 10 x 15 mm with a foot, pressed from above."""
    length, material = 0.01 * scale.length, Material(5e3 * scale.modulus, 0.4, 1.0 * scale.density)
    effects: dict[str, Effect] = {
        "foot": Pinned(),
        "poke": PressurePoke((length, 0.5 * length, 1.5 * length), 0.3 * length, 40.0 * scale.modulus),
    }
    return Scene(Geometry(), effects, material, Recording(5e-4 * scale.time, 4), solver), jittered_box(length)
