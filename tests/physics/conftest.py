"""Small solids for the physics tests, their equations of motion without a scene, and a force that follows the state."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from jaxtyping import Bool, Float64
from scipy.linalg import eigh
from skfem import MeshTet
from torch import Tensor

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import Damping, FollowsState, ForceLaw
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.mass import mass_of
from sdfnet.physics.motion import EquationOfMotion, TimedLoad
from sdfnet.physics.plan import Plan
from sdfnet.scene import Effect, Geometry


@dataclass
class Springs(ForceLaw):
    """A spring (N/m) from every node to an anchor that moves along x (m/s) from the node's place at rest, and a part that has no potential."""

    stiffness: np.ndarray  # of each node
    leak: float = 0.0
    speed: float = 0.0

    def __post_init__(self) -> None:
        self.is_driven = self.speed != 0

    def force(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> Float64[Tensor, "nodes 3"]:
        pull = -self._stretch(displacement, time) * displacement.new_tensor(self.stiffness)[:, None]
        return pull + self.leak * pull.roll(1, dims=1)

    def stored_energy(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> float:
        return 0.5 * float((self._stretch(displacement, time).numpy() ** 2 * self.stiffness[:, None]).sum())

    def drive_work(self, force: Float64[Tensor, "nodes 3"], start: float, end: float) -> float:
        return self.speed * (end - start) * float(force[:, 0].sum())

    def _stretch(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> Float64[Tensor, "nodes 3"]:
        return displacement - displacement.new_tensor([self.speed * time, 0.0, 0.0])

    def added_stiffness(self) -> Float64[np.ndarray, " nodes"]:
        return self.stiffness


@dataclass(frozen=True)
class OnSprings(FollowsState):
    """Stands every node on springs that add `share` to the largest diagonal entry of the stiffness."""

    share: float = 0.1
    leak: float = 0.0
    speed: float = 0.0  # m/s, of their far ends

    def force_law(self, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> ForceLaw:
        stiffness = np.full(len(model.elements.nodes), self.share * float(model.stiffness.diagonal().max()))
        return Springs(stiffness, self.leak, self.speed)


MakeBox = Callable[..., TetMesh]
MakeEquation = Callable[..., EquationOfMotion]


@pytest.fixture(scope="session")
def make_box() -> MakeBox:
    """A function of three rising sequences of coordinates: their grid cut into tets, inner nodes moved at random by `jitter` times the spacing."""

    def make(x: Sequence[float], y: Sequence[float], z: Sequence[float], jitter: float = 0.0) -> TetMesh:
        grid = MeshTet.init_tensor(np.asarray(x, dtype=float), np.asarray(y, dtype=float), np.asarray(z, dtype=float))
        nodes, tets = grid.p.T.copy(), grid.t.T.astype(np.int64)
        corners = nodes[tets]
        inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
        tets[inverted] = tets[inverted][:, [0, 2, 1, 3]]
        mesh = TetMesh(nodes, tets)
        if jitter == 0:
            return mesh
        inner = np.setdiff1d(np.arange(len(nodes)), mesh.surface_nodes)
        moved = nodes.copy()
        moved[inner] += jitter * mesh.smallest_edge * np.random.default_rng(3).uniform(-1, 1, (len(inner), 3))
        return TetMesh(moved, tets)

    return make


@pytest.fixture(scope="session")
def make_equation() -> MakeEquation:
    """A function of a model, its fixed components and whatever acts on the free ones: the equation of motion, with lumped mass unless told."""

    def make(
        model: ElasticModel,
        fixed: np.ndarray,
        force: np.ndarray,
        kind: str = "lumped",
        history: History | None = None,
        damping: Damping | None = None,
        displacement: np.ndarray | None = None,
        velocity: np.ndarray | None = None,
        laws: tuple[ForceLaw, ...] = (),
    ) -> EquationOfMotion:
        free = np.flatnonzero(~fixed.ravel())
        nothing = np.zeros_like(force)
        return EquationOfMotion(
            mass=mass_of(kind, model, fixed),
            stiffness=model.stiffness[free][:, free],
            constant_force=force if history is None else nothing,
            timed_loads=() if history is None else (TimedLoad(force, history),),
            damping=Damping() if damping is None else damping,
            laws=laws,
            displacement=nothing if displacement is None else displacement,
            velocity=nothing if velocity is None else velocity,
            free=free,
            n_nodes=len(fixed),
        )

    return make


@pytest.fixture(scope="session")
def make_springs() -> Callable[..., ForceLaw]:
    """A function of a model and the settings of the springs on which it stands: their force law."""
    return lambda model, **settings: OnSprings(**settings).force_law(model, np.zeros(model.elements.nodes.shape, dtype=np.bool_))


@pytest.fixture(scope="session")
def on_springs() -> type[Effect]:
    """An effect whose force follows the state: `on_springs(share=0.1)`."""
    return OnSprings


@pytest.fixture(scope="session")
def exact_in_time() -> Callable[[Plan], np.ndarray]:
    """A function of the plan of a held solid under a constant load: every mode from rest, (1 - cos omega t) / omega^2 s'f, by a dense solver."""

    def solve(compiled: Plan) -> Float64[np.ndarray, "frames nodes 3"]:
        motion, recording = compiled.equation(), compiled.scene.recording
        squared, shapes = eigh(motion.stiffness.toarray(), motion.mass.matrix().toarray())
        times = np.linspace(0, recording.duration, recording.frames)[:, None]
        amplitudes = 2 * np.sin(np.sqrt(squared) * times / 2) ** 2 / squared * (shapes.T @ motion.constant_force[:, 0])
        displacements = np.zeros((recording.frames, 3 * motion.n_nodes))
        displacements[:, motion.free] = amplitudes @ shapes.T
        return displacements.reshape(recording.frames, -1, 3)

    return solve


@pytest.fixture
def no_geometry() -> Geometry:
    """What a scene says of its solid when the test hands the mesh over itself."""
    return Geometry()
