"""The material of every tet: one for the whole solid, or several where effects put inclusions into it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.scene import Material


@dataclass(frozen=True, eq=False)
class TetMaterials:
    """Materials that differ from tet to tet. Every number of `Material` is here an array with one for each tet."""

    kinds: tuple[Material, ...]
    kind_of: Int64[np.ndarray, " tets"]  # which of them a tet has

    @property
    def youngs_modulus(self) -> Float64[np.ndarray, " tets"]:
        """Pa."""
        return self._of_each("youngs_modulus")

    @property
    def poisson_ratio(self) -> Float64[np.ndarray, " tets"]:
        """1."""
        return self._of_each("poisson_ratio")

    @property
    def density(self) -> Float64[np.ndarray, " tets"]:
        """kg/m^3."""
        return self._of_each("density")

    @property
    def lame_lambda(self) -> Float64[np.ndarray, " tets"]:
        """Pa."""
        return self._of_each("lame_lambda")

    @property
    def lame_mu(self) -> Float64[np.ndarray, " tets"]:
        """Pa."""
        return self._of_each("lame_mu")

    @property
    def bulk_modulus(self) -> Float64[np.ndarray, " tets"]:
        """Pa."""
        return self._of_each("bulk_modulus")

    @property
    def pressure_wave_speed(self) -> Float64[np.ndarray, " tets"]:
        """m/s."""
        return self._of_each("pressure_wave_speed")

    def of_parts(self, count: int) -> "TetMaterials":
        """The same when every tet is cut into so many that follow one another."""
        return TetMaterials(self.kinds, np.repeat(self.kind_of, count))

    def _of_each(self, number: str) -> Float64[np.ndarray, " tets"]:
        result: np.ndarray = np.array([getattr(kind, number) for kind in self.kinds])[self.kind_of]
        return result


Materials = Material | TetMaterials


def with_inclusions(mesh: TetMesh, material: Material, inclusions: dict[str, tuple[Bool[np.ndarray, " tets"], Material]]) -> Materials:
    """The material itself where there is no inclusion, else that of every tet. Raises ConfigurationError where two inclusions overlap."""
    if not inclusions:
        return material
    kind_of = np.zeros(len(mesh.tets), dtype=np.int64)
    names = list(inclusions)
    for index, (is_inside, _) in enumerate(inclusions.values(), start=1):
        others = kind_of[is_inside & (kind_of > 0)]
        if len(others):
            first = names[others[0] - 1]
            raise ConfigurationError(
                f"a tet has one material, found {len(others)} in '{first}' and in '{names[index - 1]}'; make the regions of the two disjoint"
            )
        kind_of[is_inside] = index
    return TetMaterials((material, *(kind for _, kind in inclusions.values())), kind_of)


def per_tet(number: float | Float64[np.ndarray, " tets"], axes: int) -> Float64[np.ndarray, "*tets_and_ones"]:
    """A material's number with so many axes of length one behind its axis of tets, which has length one too when all tets share it."""
    return np.reshape(number, (-1,) + axes * (1,))
