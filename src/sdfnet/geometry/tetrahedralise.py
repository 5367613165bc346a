"""fTetWild behind one function: a closed surface in, a tet mesh out (paper section 1)."""

from contextlib import chdir
from tempfile import TemporaryDirectory

import numpy as np
import pytetwild
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from sdfnet.errors import GeometryError
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh


def tetrahedralise(surface: Surface, edge_length: float = 0.05, envelope: float = 1e-3, stop_energy: float = 50.0, simplify: bool = True) -> TetMesh:
    """Fill a surface with tets.

    `edge_length` and `envelope` (how far the result may leave the input) are fractions of the bounding box diagonal;
    `stop_energy` is the AMIPS energy at which mesh improvement stops: lower is better shaped and slower. fTetWild uses
    threads and does not repeat itself to the bit; name what you build from the result by `TetMesh.digest`.
    Raises GeometryError when fTetWild leaves nothing, and for what it does not refuse itself: no faces (it ends the
    program) and vertices that are not finite (it fills something else).
    """
    if len(surface.faces) == 0:
        raise GeometryError("fTetWild needs a surface with faces, found none")
    if not np.isfinite(surface.vertices).all():
        raise GeometryError(f"fTetWild needs finite vertices, found {int((~np.isfinite(surface.vertices)).any(axis=1).sum())} that are not")
    with TemporaryDirectory() as scratch, chdir(scratch):  # fTetWild leaves a file in the working folder
        nodes, tets = pytetwild.tetrahedralize(
            surface.vertices,
            surface.faces.astype(np.int32),
            edge_length_fac=edge_length,
            epsilon=envelope,
            stop_energy=stop_energy,
            simplify=simplify,
            quiet=True,
        )
    if len(tets) == 0:
        raise GeometryError("fTetWild left no tets; the surface encloses nothing at this edge length, lower geometry.edge_length")
    # fTetWild winds its tets the other way round.
    return neighbours_together(TetMesh(nodes.astype(np.float64), tets[:, [0, 2, 1, 3]].astype(np.int64)))


def neighbours_together(mesh: TetMesh) -> TetMesh:
    """The same mesh with its nodes in reverse Cuthill-McKee order, so that what a sparse product reads together lies together in memory."""
    ends = np.repeat(mesh.tets, 4, axis=1).ravel(), np.tile(mesh.tets, 4).ravel()
    order = reverse_cuthill_mckee(csr_matrix((np.ones(len(ends[0])), ends), shape=2 * (len(mesh.nodes),)), symmetric_mode=True)
    return TetMesh(mesh.nodes[order], np.argsort(order).astype(np.int64)[mesh.tets])
