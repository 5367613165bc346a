"""The paper's scene: a finger presses the Stanford Bunny's nose, and its head tilts back (paper sections 1 to 3)."""

from sdfnet.geometry.solids import ClosedSurface
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.regions import HalfSpace
from sdfnet.plugins import dataset
from sdfnet.scene import Dataset, Material, Recording, Sampling, Scene


@dataset
def bunny_poke() -> Dataset:
    """Every number is the paper's but for the nose's position, which it shows in Figure 2 and does not print."""
    return Dataset(
        scene=Scene(
            geometry=ClosedSurface(x_extent=0.1551, foot_depth=0.007),
            material=Material(youngs_modulus=5e3, poisson_ratio=0.40, density=1.0),
            effects={
                "foot": Pinned(region=HalfSpace(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))),
                "poke": PressurePoke(center=(0.0, -0.024, 0.086), radius=0.003, pressure=4000.0),
            },
            recording=Recording(duration=0.01, frames=101),
        ),
        sampling=Sampling(count=1_000_000),
    )
