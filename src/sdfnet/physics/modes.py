"""Natural frequencies and modes of vibration."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.linalg import eigh
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from sdfnet.checked import taken
from sdfnet.errors import ConfigurationError
from sdfnet.physics.mass import ConsistentMass, Mass

DENSE_SIZE = 400  # up to so many unknowns, and for more than half of all modes, the dense solver is the faster
LANCZOS_TOLERANCE = 1e-9  # relative, on the largest omega^2, which Lanczos approaches from below
LANCZOS_ROOM = 30  # below so many unknowns Lanczos has none and the dense solver is instant
SHIFT = 1e-10  # of the largest K_ii / M_ii: makes the stiffness of a free solid regular and moves no elastic mode by more


@dataclass(frozen=True, eq=False)
class Modes:
    """K s = omega^2 M s, the slowest first; columns have s'Ms = 1. A free solid begins with six modes of frequency zero."""

    angular_frequencies: Float64[np.ndarray, " modes"]  # 1/s
    shapes: Float64[np.ndarray, "dofs modes"]  # kg^-1/2

    @property
    def frequencies(self) -> Float64[np.ndarray, " modes"]:
        """Natural frequencies, Hz."""
        return self.angular_frequencies / (2 * np.pi)


class ShiftedStiffness:
    """K + s M, factorised once: regular also where nothing holds the solid."""

    def __init__(self, stiffness: csr_matrix, mass: Mass) -> None:
        matrix = csc_matrix(mass.matrix())
        self.shift = SHIFT * float((stiffness.diagonal() / matrix.diagonal()).max())
        shifted = csc_matrix(stiffness + self.shift * matrix)
        self._factor = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(self, force: Float64[np.ndarray, "*dofs_columns"]) -> Float64[np.ndarray, "*dofs_columns"]:
        """(K + s M)^-1 f, m."""
        result: np.ndarray = self._factor.solve(force)
        return result


def modes(stiffness: csr_matrix, mass: Mass, count: int, shifted: ShiftedStiffness | None = None) -> Modes:
    """The `count` slowest modes: Lanczos on the shifted inverse, or all of them densely on a small mesh.

    `shifted` is a factor that the caller already has. Raises ConfigurationError for more modes than unknowns.
    """
    size, count = stiffness.shape[0], taken("the number of modes", count, int)
    if not 1 <= count <= size:
        raise ConfigurationError(f"the number of modes must lie between 1 and the {size} free degrees of freedom, found {count}")
    if size <= DENSE_SIZE or 2 * count > size:
        values, shapes = eigh(stiffness.toarray(), mass.matrix().toarray(), subset_by_index=(0, count - 1))
    else:
        factor = ShiftedStiffness(stiffness, mass) if shifted is None else shifted
        inverse = LinearOperator((size, size), matvec=factor.solve, dtype=np.float64)
        start = np.random.default_rng(0).standard_normal(size)  # fixed, so that the modes do not change from run to run
        values, shapes = eigsh(stiffness, k=count, M=mass.matrix(), sigma=-factor.shift, OPinv=inverse, v0=start)
        order = np.argsort(values)
        values, shapes = values[order], shapes[:, order]
    return Modes(np.sqrt(np.maximum(values, 0.0)), shapes)  # a zero frequency may come out as the root of a negative rounding error


def largest_eigenvalue(matrix: csr_matrix, mass: ConsistentMass | None) -> float:
    """The largest lambda of A x = lambda M x, with M = 1 for None: omega_max^2."""
    size = matrix.shape[0]
    start = np.random.default_rng(0).standard_normal(size)  # fixed, so that the step does not change from run to run
    if mass is None:
        if size < LANCZOS_ROOM:
            return float(np.linalg.eigvalsh(matrix.toarray())[-1])
        return float(eigsh(matrix, k=1, which="LA", v0=start, tol=LANCZOS_TOLERANCE, return_eigenvectors=False)[0])
    if size < LANCZOS_ROOM:
        return float(np.linalg.eigvals(mass.solve(matrix.toarray())).real.max())
    product = LinearOperator((size, size), matvec=lambda x: mass.product(x.reshape(-1, 1)).ravel(), dtype=np.float64)
    inverse = LinearOperator((size, size), matvec=lambda x: mass.solve(x.reshape(-1, 1)).ravel(), dtype=np.float64)
    return float(eigsh(matrix, k=1, M=product, Minv=inverse, which="LA", v0=start, tol=LANCZOS_TOLERANCE, return_eigenvectors=False)[0])
