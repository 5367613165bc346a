# mypy: ignore-errors
"""The Warp kernel behind `sdfnet.geometry.distance`: its annotations are Warp's language, not Python's."""

import warp as wp


@wp.kernel(enable_backward=False)
def query_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    bounds: wp.array(dtype=wp.float32),
    face_normals: wp.array(dtype=wp.vec3),
    edge_normals: wp.array2d(dtype=wp.vec3),
    corner_normals: wp.array2d(dtype=wp.vec3),
    tolerance: float,
    distances: wp.array(dtype=wp.float32),
    faces: wp.array(dtype=wp.int32),
):
    """For each point within its bound, the signed distance to the nearest face and that face's index; beyond it the bound and -1."""
    i = wp.tid()
    point = points[i]
    query = wp.mesh_query_point_no_sign(mesh, point, bounds[i])
    faces[i] = -1
    distances[i] = bounds[i]
    if query.result:
        u = query.u
        v = query.v
        w = 1.0 - u - v
        face = query.face
        normal = face_normals[face]
        if u > 1.0 - tolerance:
            normal = corner_normals[face, 0]
        elif v > 1.0 - tolerance:
            normal = corner_normals[face, 1]
        elif w > 1.0 - tolerance:
            normal = corner_normals[face, 2]
        elif w < tolerance:
            normal = edge_normals[face, 0]
        elif u < tolerance:
            normal = edge_normals[face, 1]
        elif v < tolerance:
            normal = edge_normals[face, 2]
        offset = point - wp.mesh_eval_position(mesh, face, u, v)
        distances[i] = wp.length(offset) * wp.where(wp.dot(offset, normal) < 0.0, -1.0, 1.0)
        faces[i] = face
