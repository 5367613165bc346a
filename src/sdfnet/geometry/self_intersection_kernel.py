# mypy: ignore-errors
"""The Warp kernel behind `sdfnet.geometry.self_intersection`: its annotations are Warp's language, not Python's."""

import warp as wp


@wp.func
def piercings(edges: wp.mat33d, triangle: wp.mat33d, only: int, tolerance: wp.float64) -> wp.vec4d:
    """Where the edges of one triangle go through another (rows are corners): the sum of the places and, last, their number.

    `only` is the corner whose opposite edge alone is tested, -1 for all three. An edge pierces when its ends lie more
    than `tolerance` off the other's plane on different sides and its line passes the triangle or its rim.
    """
    zero = wp.float64(0.0)
    side = triangle[1] - triangle[0]
    other_side = triangle[2] - triangle[0]
    longest = wp.max(wp.max(wp.dot(side, side), wp.dot(other_side, other_side)), wp.length_sq(other_side - side))
    margin = tolerance * longest  # against the squared edge, not the area, so that a sliver's rounding is covered too
    normal = wp.cross(side, other_side)
    heights = wp.vec3d(wp.dot(normal, edges[0] - triangle[0]), wp.dot(normal, edges[1] - triangle[0]), wp.dot(normal, edges[2] - triangle[0]))
    total = wp.vec4d()
    if wp.max(heights) > margin and wp.min(heights) < -margin:
        for k in range(3):
            start = edges[(k + 1) % 3]
            end = edges[(k + 2) % 3]
            above = heights[(k + 1) % 3]
            below = heights[(k + 2) % 3]
            if (only < 0 or only == k) and ((above > margin and below < -margin) or (above < -margin and below > margin)):
                a = triangle[0] - start
                b = triangle[1] - start
                c = triangle[2] - start
                along = end - start
                u = wp.dot(along, wp.cross(a, b))
                v = wp.dot(along, wp.cross(b, c))
                w = wp.dot(along, wp.cross(c, a))
                if (u >= zero and v >= zero and w >= zero) or (u <= zero and v <= zero and w <= zero):
                    place = start + along * (above / (above - below))
                    total += wp.vec4d(place[0], place[1], place[2], wp.float64(1.0))
    return total


@wp.func
def corners_of(vertices: wp.array(dtype=wp.vec3d), faces: wp.array2d(dtype=wp.int32), face: int) -> wp.mat33d:
    """The corners of a face as rows."""
    return wp.matrix_from_rows(vertices[faces[face, 0]], vertices[faces[face, 1]], vertices[faces[face, 2]])


@wp.kernel(enable_backward=False)
def crossing_kernel(
    mesh: wp.uint64,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array2d(dtype=wp.int32),
    box_margin: float,
    tolerance: wp.float64,
    count: wp.array(dtype=wp.int32),
    pairs: wp.array2d(dtype=wp.int32),
    places: wp.array(dtype=wp.vec3d),
):
    """For each face, count the faces of higher index that it crosses, and list them as long as there is room."""
    i = wp.tid()
    own = corners_of(vertices, faces, i)
    lower = wp.vec3(wp.min(own[0], wp.min(own[1], own[2])))
    upper = wp.vec3(wp.max(own[0], wp.max(own[1], own[2])))
    margin = wp.vec3(box_margin, box_margin, box_margin)
    query = wp.mesh_query_aabb(mesh, lower - margin, upper + margin)
    j = wp.int32(0)
    while wp.mesh_query_aabb_next(query, j):
        if j > i:
            shared = wp.int32(0)
            own_corner = wp.int32(-1)
            other_corner = wp.int32(-1)
            for m in range(3):
                for n in range(3):
                    if faces[i, m] == faces[j, n]:
                        shared += 1
                        own_corner = m
                        other_corner = n
            if shared < 2:
                other = corners_of(vertices, faces, j)
                found = piercings(own, other, own_corner, tolerance) + piercings(other, own, other_corner, tolerance)
                if found[3] > wp.float64(0.0):
                    place = wp.vec3d(found[0], found[1], found[2]) / found[3]
                    if shared == 1:  # the crossing runs from the shared corner to where the opposite edge goes through
                        place = wp.float64(0.5) * (place + vertices[faces[i, own_corner]])
                    slot = wp.atomic_add(count, 0, 1)
                    if slot < pairs.shape[0]:
                        pairs[slot, 0] = i
                        pairs[slot, 1] = j
                        places[slot] = place
