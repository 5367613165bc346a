"""What can be read, and what is refused with which words."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Usd, UsdGeom

from sdfnet.errors import GeometryError
from sdfnet.geometry.inspection import inspection
from sdfnet.geometry.surface import Surface, load_surface

UNIT_CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]])


def _ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=1, radius=0.1)


def _surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


def _write_usd(path: Path, vertices: np.ndarray, faces: np.ndarray, parent: Gf.Matrix4d | None = None) -> None:
    stage = Usd.Stage.CreateNew(str(path))
    group = UsdGeom.Xform.Define(stage, "/group")
    if parent is not None:
        group.AddTransformOp().Set(parent)
    mesh = UsdGeom.Mesh.Define(stage, "/group/solid")
    mesh.CreatePointsAttr([tuple(map(float, vertex)) for vertex in vertices])
    mesh.CreateFaceVertexCountsAttr([faces.shape[1]] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
    stage.GetRootLayer().Save()


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "off", "usda", "usdc", "usd"])
def test_every_format_gives_the_same_closed_surface(kind: str) -> None:
    ball, path = _ball(), Path(f"ball.{kind}")
    if kind.startswith("usd"):
        _write_usd(path, ball.vertices, ball.faces)
    else:
        ball.export(path)
    surface = load_surface(path)
    assert inspection(surface).problems() == []
    assert surface.vertices.shape == (42, 3)  # an .stl holds 240, merged on reading
    assert surface.faces.shape == (80, 3)
    # float32 and eight printed digits of a 0.1 m ball
    np.testing.assert_allclose(np.sort(surface.vertices[:, 0]), np.sort(ball.vertices[:, 0]), atol=1e-8)
    assert surface.as_trimesh().volume == pytest.approx(ball.volume, rel=1e-6)
    assert surface.diagonal == pytest.approx(np.linalg.norm(np.ptp(ball.vertices, axis=0)), rel=1e-6)


def test_a_usd_mesh_is_read_where_its_parents_put_it() -> None:
    ball = _ball()
    parent = Gf.Matrix4d().SetScale(2.0) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(1.0, 2.0, 3.0))
    _write_usd(Path("moved.usda"), ball.vertices, ball.faces, parent)
    found = load_surface(Path("moved.usda")).vertices
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(2 * ball.vertices + [1.0, 2.0, 3.0], axis=0), atol=1e-6)


def test_quads_of_an_obj_become_triangles() -> None:
    Path("quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert load_surface(Path("quad.obj")).faces.shape == (2, 3)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e3])
def test_repeated_vertices_are_merged_whatever_the_scale(scale: float) -> None:
    ball = _ball()
    triangles = scale * ball.vertices[ball.faces].reshape(-1, 3)
    trimesh.Trimesh(triangles, np.arange(len(triangles)).reshape(-1, 3), process=False).export("soup.ply")
    surface = load_surface(Path("soup.ply"))
    assert len(surface.vertices) == 42
    assert inspection(surface).problems() == []


def test_a_missing_file_names_the_path_and_the_formats() -> None:
    with pytest.raises(GeometryError, match=r"no surface file at 'nowhere\.obj'; give an existing \.obj, \.ply, \.stl, \.off or \.usd"):
        load_surface(Path("nowhere.obj"))


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "off", "usd", "usda", "usdc", "txt"])
@pytest.mark.parametrize("content", [b"", b"these are words, no mesh\n" * 20, bytes(range(256)) * 2], ids=["empty", "words", "bytes"])
def test_a_foreign_file_is_refused_by_name(kind: str, content: bytes) -> None:
    path = Path(f"foreign.{kind}")
    path.write_bytes(content)
    with pytest.raises(GeometryError, match=rf"'foreign\.{kind}' (holds no triangles|could not be read)"):
        load_surface(path)


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "off"])
def test_a_file_cut_in_half_is_refused_with_its_bytes_the_readers_reason_and_the_cure(kind: str) -> None:
    path = Path(f"cut.{kind}")
    _ball().export(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    words = rf"could not be read: it must be a whole \.obj, .*, found {path.stat().st_size} bytes that end early or are something else: \w.*; export it again"
    with pytest.raises(GeometryError, match="holds no triangles" if kind == "stl" else words) as caught:
        load_surface(path)
    assert f"'cut.{kind}'" in str(caught.value)


def test_points_without_faces_are_refused() -> None:
    trimesh.PointCloud(_ball().vertices).export("points.ply")
    with pytest.raises(GeometryError, match="'points.ply' holds no triangles"):
        load_surface(Path("points.ply"))


def test_vertices_that_are_not_finite_are_counted() -> None:
    Path("nan.obj").write_text("v 0 0 0\nv nan 0 0\nv 0 inf 0\nf 1 2 3\n")
    with pytest.raises(GeometryError, match="'nan.obj' has 2 vertices that are not finite"):
        load_surface(Path("nan.obj"))


def test_a_usd_without_exactly_one_triangle_mesh_says_what_it_holds() -> None:
    quad = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
    _write_usd(Path("quad.usda"), quad, np.array([[0, 1, 2, 3]]))
    with pytest.raises(GeometryError, match=r"must hold triangles, found faces of \[4\] corners; triangulate it first"):
        load_surface(Path("quad.usda"))
    empty = Usd.Stage.CreateNew("none.usda")
    empty.GetRootLayer().Save()
    with pytest.raises(GeometryError, match="must hold exactly one mesh, found 0"):
        load_surface(Path("none.usda"))
    stage = Usd.Stage.CreateNew("bare.usda")
    UsdGeom.Mesh.Define(stage, "/bare")
    stage.GetRootLayer().Save()
    with pytest.raises(GeometryError, match="'bare.usda' holds no triangles"):
        load_surface(Path("bare.usda"))


def test_a_usd_face_that_names_a_vertex_beyond_the_last_is_refused() -> None:
    _write_usd(Path("beyond.usda"), UNIT_CORNERS, np.array([[0, 1, 2], [0, 2, 4]]))
    with pytest.raises(GeometryError, match="'beyond.usda' could not be read: a face names vertex 4 of 4; export it again"):
        load_surface(Path("beyond.usda"))


def test_vertices_that_no_face_uses_are_left_out() -> None:
    _write_usd(Path("lonely.usda"), np.vstack([[[9.0, 9, 9]], UNIT_CORNERS]), np.array([[1, 2, 3]]))
    assert load_surface(Path("lonely.usda")).vertices.tolist() == UNIT_CORNERS[:3].tolist()
