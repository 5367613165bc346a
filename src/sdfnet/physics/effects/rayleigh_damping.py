"""Damping that leaves the modes as they are."""

import math
from dataclasses import dataclass

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.roles import AddsDamping, Damping
from sdfnet.physics.elasticity import ElasticModel


@dataclass(frozen=True)
class RayleighDamping(AddsDamping):
    """C = mass * M + stiffness * K, with `mass` in 1/s and `stiffness` in s (Rayleigh 1877).

    A mode of angular frequency w (1/s) decays as exp(-x w t) with the ratio x = (mass / w + stiffness w) / 2: the first
    part damps the slow modes and rigid motion, the second the fast ones and makes the stable step smaller. For a solid
    that should come to rest. Not for a measured material over many frequencies: x is as wanted at two of them only.
    """

    mass: float = 0.0  # 1/s
    stiffness: float = 0.0  # s

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unit in (("mass", "1/s"), ("stiffness", "s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigurationError(f"rayleigh_damping.{name} must be finite and not negative, found {value} {unit}; negative damping feeds the motion")

    @classmethod
    def from_ratios(cls, ratios: tuple[float, float], frequencies: tuple[float, float]) -> "RayleighDamping":
        """The damping with these ratios (1 is critical) at two frequencies (Hz).

        With w = 2 pi f: mass = 2 w1 w2 (x1 w2 - x2 w1) / (w2^2 - w1^2), stiffness = 2 (x2 w2 - x1 w1) / (w2^2 - w1^2).
        Raises ConfigurationError for equal frequencies and for ratios so different that a part would be negative.
        """
        if not (all(math.isfinite(frequency) and frequency > 0 for frequency in frequencies) and frequencies[0] != frequencies[1]):
            raise ConfigurationError(f"damping frequencies must be positive and not equal, found {frequencies} Hz")
        if not all(math.isfinite(ratio) and ratio >= 0 for ratio in ratios):
            raise ConfigurationError(f"damping ratios must be finite and not negative, found {ratios}")
        (first, second), (slow, fast) = ratios, (2 * math.pi * frequency for frequency in frequencies)
        difference = fast**2 - slow**2
        mass, stiffness = 2 * slow * fast * (first * fast - second * slow) / difference, 2 * (second * fast - first * slow) / difference
        if min(mass, stiffness) < 0:
            raise ConfigurationError(
                f"damping ratios {ratios} at {frequencies} Hz would need mass {mass:.4g} 1/s and stiffness {stiffness:.4g} s, and neither may be negative; "
                f"choose the second ratio between {first * min(slow / fast, fast / slow):.4g} and {first * max(slow / fast, fast / slow):.4g}"
            )
        return cls(mass, stiffness)

    def damping(self, model: ElasticModel) -> Damping:
        """The two coefficients."""
        return Damping(self.mass, self.stiffness)
