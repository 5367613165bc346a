"""A ball pressed from both sides, the smallest scene: made in a second, used by the smoke run and the tests."""

from sdfnet.geometry.solids import Sphere
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.plugins import dataset
from sdfnet.scene import Dataset, Material, Recording, Sampling, Scene


@dataset
def sphere_squeeze() -> Dataset:
    """Two equal pokes at the poles; nothing is pinned, because the loads balance."""
    return Dataset(
        scene=Scene(
            geometry=Sphere(radius=0.05, cells=8),
            material=Material(youngs_modulus=5e3, poisson_ratio=0.40, density=1.0),
            effects={
                "left": PressurePoke(center=(-0.05, 0.0, 0.0), radius=0.02, pressure=1000.0),
                "right": PressurePoke(center=(0.05, 0.0, 0.0), radius=0.02, pressure=1000.0),
            },
            recording=Recording(duration=0.001, frames=11),
        ),
        sampling=Sampling(count=20_000, near_surface_count=10_000),
    )
