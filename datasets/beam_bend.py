"""A cantilever that bends under its weight: a box held at one end, made in seconds."""

from sdfnet.geometry.solids import Box
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.regions import HalfSpace
from sdfnet.plugins import dataset
from sdfnet.scene import Dataset, Material, Recording, Sampling, Scene


@dataset
def beam_bend() -> Dataset:
    """A quarter of the first bending mode's period, so that the tip moves one way."""
    return Dataset(
        scene=Scene(
            geometry=Box(size=(0.2, 0.04, 0.04), cells=(15, 3, 3)),
            material=Material(youngs_modulus=5e3, poisson_ratio=0.30, density=1.0),
            effects={
                "wall": Pinned(region=HalfSpace(point=(0.0, 0.0, 0.0), normal=(1.0, 0.0, 0.0))),
                "weight": BodyForce(density=(0.0, 0.0, -100.0)),
            },
            recording=Recording(duration=0.02, frames=21),
        ),
        sampling=Sampling(count=40_000, near_surface_count=20_000),
    )
