"""The paper's way to simulate its 10 ms against sdfnet's: python benchmarks/paper_way.py [steps]

The paper's way: consistent mass; at every step of 1e-6 s the load vector of its weak form is assembled (inertia, pressure
on the patch, internal stress) and the mass is solved with. Given in its favour: the mass is factorised once, and the
pressure is integrated with few points. `steps` runs only so many of the 10,000 and counts the rest as equally long.
"""

import logging
import sys
import time
from pathlib import Path

import numpy as np
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, FacetBasis, LinearForm, MeshTet
from skfem.helpers import ddot, dot, sym_grad
from skfem.models.elasticity import linear_stress

from sdfnet.data.prepare import prepare_mesh
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.plan import plan
from sdfnet.physics.simulate import run
from sdfnet.plugins import find_datasets

TIME_STEP, STEPS = 1e-6, 10_000


def paper_seconds(scene, mesh, steps: int) -> tuple[float, np.ndarray]:
    """Seconds of so many steps in the paper's way, assembly of the mass and its factor aside, and the last displacement (nodes, 3)."""
    foot, poke, material = scene.effects["foot"], scene.effects["poke"], scene.material
    assert isinstance(foot, Pinned)
    assert isinstance(poke, PressurePoke)
    skfem_mesh = MeshTet(np.ascontiguousarray(mesh.nodes.T), np.ascontiguousarray(mesh.tets.T))
    element = ElementVector(ElementTetP1())
    volume, surface = Basis(skfem_mesh, element, intorder=2), FacetBasis(skfem_mesh, element, intorder=6)
    stress = linear_stress(material.lame_lambda, material.lame_mu)
    center = np.asarray(poke.center)[:, None, None]
    inside_volume = LinearForm(lambda v, w: material.density * dot(w["velocity"], v) - TIME_STEP * ddot(stress(sym_grad(w["displacement"])), sym_grad(v)))
    on_surface = LinearForm(lambda v, w: -TIME_STEP * poke.pressure * (((w.x - center) ** 2).sum(axis=0) <= poke.radius**2) * dot(w.n, v))
    mass = BilinearForm(lambda u, v, _: material.density * dot(u, v)).assemble(volume).tocsc()
    fixed = plan(scene, mesh).fixed.ravel()
    free = np.flatnonzero(~fixed)
    factor = splu(mass[free][:, free])
    displacement, velocity = np.zeros(mass.shape[0]), np.zeros(mass.shape[0])
    began = time.perf_counter()
    for _ in range(steps):
        right = inside_volume.assemble(volume, velocity=volume.interpolate(velocity), displacement=volume.interpolate(displacement)) + on_surface.assemble(
            surface
        )
        velocity[free] = factor.solve(right[free])
        displacement += TIME_STEP * velocity
    return time.perf_counter() - began, displacement.reshape(-1, 3)


def main(steps: int) -> None:
    """Print both times, their ratio, and how far apart the two results are."""
    logging.getLogger("skfem").setLevel(logging.WARNING)
    dataset = find_datasets()["bunny_poke"]
    mesh = prepare_mesh(dataset, Path("outputs/data"))
    compiled = plan(dataset.scene, mesh)
    ours = sorted(float(run(compiled).report["step_seconds"]) for _ in range(3))[1]
    seconds, displacement = paper_seconds(dataset.scene, mesh, steps)
    paper = seconds * STEPS / steps
    print(f"sdfnet, lumped mass, {compiled.steps} steps of {compiled.time_step:.3e} s: {ours:.2f} s (median of 3 runs)")
    print(f"the paper's way, consistent mass, {STEPS} steps of {TIME_STEP:.0e} s: {paper:.0f} s ({1e3 * seconds / steps:.1f} ms per step, {steps} steps run)")
    print(f"ratio: {paper / ours:.0f}")
    if steps == STEPS:
        difference = np.linalg.norm(run(compiled).displacements[-1] - displacement) / np.linalg.norm(displacement)
        print(f"displacements of the last frame differ by {100 * difference:.1f} % (mass and time step)")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else STEPS)
