# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious twins of the kernels of `vitamin3d.dense`, and the small scenes that its tests share."""

import itertools

import numpy as np

from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.types import Frame, MapSnapshot

EUROC = PinholeCamera(458.654, 457.296, 367.215, 248.375, 752, 480, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
SMALL = PinholeCamera(100.0, 100.0, 63.5, 47.5, 128, 96)


def snapshot_of_plane(camera, normal, count, rng, deviation=0.01, T_cam_world=None):
    """Landmarks on the plane <normal, X_cam> = 1 at random pixels, without noise; the picture is a grey ramp."""
    pixels = rng.uniform(0, [camera.width - 1, camera.height - 1], (count, 2))
    depths = 1.0 / (camera.rays_from_ideal(pixels) @ np.asarray(normal, float))
    image = np.tile(np.linspace(50, 200, camera.width).astype(np.uint8), (camera.height, 1))
    T = np.eye(4) if T_cam_world is None else T_cam_world
    return MapSnapshot(Frame(0, 7, image), T, pixels, depths, np.full(count, deviation))


def edges_of(triangles):
    """The set of edges, each once."""
    pairs = {tuple(sorted((int(a), int(b)))) for t in triangles for a, b in itertools.combinations(t, 2)}
    return np.array(sorted(pairs))


def nltgv_objective(problem, state):
    energy = 0.0
    for (i, j), d in zip(problem.edges, problem.offsets, strict=True):
        energy += abs(state[i, 0] - state[j, 0] - state[i, 1:] @ d) / np.linalg.norm(d)
        energy += problem.beta * np.abs(state[i, 1:] - state[j, 1:]).sum()
    for v, z in enumerate(problem.data):
        energy += problem.data_weights[v] * abs(state[v, 0] - z)
    return energy


def nltgv_matrix(problem):
    """K (3 E, 3 V) dense: the first two terms of the energy are |K x|_1 with x = (xi, w_u, w_v) of every vertex."""
    K = np.zeros((3 * len(problem.edges), 3 * len(problem.data)))
    for e, ((i, j), d) in enumerate(zip(problem.edges, problem.offsets, strict=True)):
        alpha = 1.0 / np.linalg.norm(d)
        K[3 * e, 3 * i], K[3 * e, 3 * j] = alpha, -alpha
        K[3 * e, 3 * i + 1], K[3 * e, 3 * i + 2] = -alpha * d[0], -alpha * d[1]
        for k in (1, 2):
            K[3 * e + k, 3 * i + k], K[3 * e + k, 3 * j + k] = problem.beta, -problem.beta
    return K


def nltgv_solve(problem, start, iterations):
    """Pock and Chambolle (2011), Algorithm 1 with alpha = 1, on the dense matrix; the steps in the problem's ratio."""
    K, share = nltgv_matrix(problem), problem.primal_share
    sigma, tau = 1.0 / np.abs(K).sum(axis=1) / share, share / np.abs(K).sum(axis=0)
    z, threshold = problem.data, tau[0::3] * problem.data_weights
    x, q = start.ravel().copy(), np.zeros(len(K))
    x_bar = x.copy()
    for _ in range(iterations):
        q = np.clip(q + sigma * (K @ x_bar), -1.0, 1.0)
        moved = x - tau * (K.T @ q)
        residual = moved[0::3] - z
        moved[0::3] = z + np.sign(residual) * np.maximum(np.abs(residual) - threshold, 0.0)
        x_bar, x = 2.0 * moved - x, moved
    return x.reshape(-1, 3)


def rasterize(pixels, triangles, layers, width, height):
    """Every pixel against every triangle, by barycentric coordinates."""
    out = np.zeros((height, width, layers.shape[1]))
    for v, u in itertools.product(range(height), range(width)):
        for t in triangles:
            corners = np.vstack([pixels[t].T, np.ones(3)])
            if abs(np.linalg.det(corners)) < 1e-12:
                continue
            weights = np.linalg.solve(corners, [u, v, 1.0])
            value = weights @ layers[t]
            if weights.min() >= -1e-9 and value[0] > out[v, u, 0]:
                out[v, u] = value
    return out


def depth_and_normals(layers, camera):
    """From three points of each pixel's plane."""
    depth, normals = np.zeros(layers.shape[:2]), np.zeros(layers.shape)
    for v, u in zip(*np.nonzero(layers[..., 0]), strict=True):
        xi, slope = layers[v, u, 0], layers[v, u, 1:]
        step = 1e-3 * xi / (np.abs(slope).max() + 1e-9)
        near = np.array([[u, v], [u + step, v], [u, v + step]], float)
        a, b, c = camera.rays_from_ideal(near) / (xi + (near - near[0]) @ slope)[:, None]
        normal = np.cross(b - a, c - a)
        depth[v, u], normals[v, u] = a[2], -np.sign(normal @ a) * normal / np.linalg.norm(normal)
    return depth, normals


def zero_crossings(distance, is_known, color):
    """Rows [x, y, z, r, g, b] where the sign changes along an edge of some cube of known voxels; fields indexed [x, y, z]."""
    found = {}
    for corner in itertools.product(*(range(n - 1) for n in distance.shape)):
        cube = [tuple(np.add(corner, step)) for step in itertools.product(range(2), repeat=3)]
        if not all(is_known[voxel] for voxel in cube):
            continue
        for a, b in itertools.combinations(cube, 2):
            if np.abs(np.subtract(a, b)).sum() == 1 and (distance[a] < 0) != (distance[b] < 0):
                share = distance[a] / (distance[a] - distance[b])
                place = (1 - share) * np.array(a) + share * np.array(b)
                found[a, b] = [*place, *((1 - share) * color[a] + share * color[b])]
    return np.array([found[key] for key in sorted(found)])


def component_sizes(triangles):
    """Flood fill over triangles that share a vertex."""
    left, sizes = set(range(len(triangles))), np.zeros(len(triangles), int)
    while left:
        piece, grown = set(), {min(left)}
        while grown:
            piece |= grown
            corners = {int(v) for f in grown for v in triangles[f]}
            grown = {f for f in left - piece if corners & {int(v) for v in triangles[f]}}
        sizes[list(piece)] = len(piece)
        left -= piece
    return sizes


def vertex_normals(vertices, triangles):
    normals = np.zeros_like(vertices)
    for a, b, c in triangles:
        for v in (a, b, c):
            normals[v] += np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a])
    return np.array([n / np.linalg.norm(n) if np.linalg.norm(n) > 0 else n for n in normals])


def census(image):
    """Strings of "darker than the centre" over the 9×7 window, row by row; None where it leaves the image or holds a zero."""
    height, width = image.shape
    out = np.full(image.shape, None, object)
    for v, u in itertools.product(range(3, height - 3), range(4, width - 4)):
        window = image[v - 3 : v + 4, u - 4 : u + 5].astype(int)
        if (window > 0).all():
            out[v, u] = "".join("1" if x < image[v, u] else "0" for x in np.delete(window.ravel(), 31))
    return out


def sweep_cost(image, sources, motions, camera, inverse_depths):
    """Cost (H, W, D): the mean of the two lowest census distances among the sources that see the point."""
    reference, others = census(image), [census(source) for source in sources]
    cost = np.full((*image.shape, len(inverse_depths)), 24.0)
    for v, u, d in np.ndindex(cost.shape):
        if reference[v, u] is None:
            continue
        distances = []
        for signature, motion in zip(others, motions, strict=True):
            x = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]) + inverse_depths[d] * motion
            a, b = camera.fx * x[0] / x[2] + camera.cx, camera.fy * x[1] / x[2] + camera.cy
            a, b = int(np.floor(a + 0.5)), int(np.floor(b + 0.5))
            if 0 <= a < camera.width and 0 <= b < camera.height and signature[b, a] is not None:
                distances.append(sum(p != q for p, q in zip(reference[v, u], signature[b, a], strict=True)))
        if distances:
            lowest = sorted(distances)[:2]
            cost[v, u, d] = np.mean(lowest) + (2.0 if len(lowest) == 1 else 0.0)
    return cost


def path_cost(cost, image, small, large, step):
    """Costs of one path, pixel by pixel along `step` (dv, du), by the definition."""
    out = np.zeros(cost.shape)
    height, width, planes = cost.shape
    rows = range(height) if step[0] >= 0 else range(height - 1, -1, -1)
    columns = range(width) if step[1] >= 0 else range(width - 1, -1, -1)
    for v, u in itertools.product(rows, columns):
        w, x = v - step[0], u - step[1]
        if not (0 <= w < height and 0 <= x < width):
            out[v, u] = cost[v, u]
            continue
        edge = np.rint(max(large * 10.0 / (10.0 + abs(float(image[v, u]) - float(image[w, x]))), 1.5 * small))
        before = out[w, x]
        for d in range(planes):
            jumps = [before[k] + (0 if k == d else small if abs(k - d) == 1 else edge) for k in range(planes)]
            out[v, u, d] = cost[v, u, d] + min(min(jumps), before.min() + edge) - before.min()
    return out


def zncc(a, b):
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum() + 1e-9))


def signed_distances(views, canvas, points, truncation, max_depth):
    """Weighted mean distances along the rays (N,), in truncations, and weights (N,) of points (N, 3), view by view."""
    total, weight = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        for n, point in enumerate(points):
            x = view.T_cam_world[:3, :3] @ point + view.T_cam_world[:3, 3]
            if x[2] <= 0:
                continue
            u = int(np.floor(canvas.fx * x[0] / x[2] + canvas.cx + 0.5))
            v = int(np.floor(canvas.fy * x[1] / x[2] + canvas.cy + 0.5))
            if not (0 <= u < canvas.width and 0 <= v < canvas.height and 0 < view.depth[v, u] < max_depth):
                continue
            signed = (view.depth[v, u] - x[2]) * np.linalg.norm(x / x[2]) / truncation
            if signed < -1:
                continue
            w = view.weights[v, u] * min(1.0, 1.0 + signed)
            total[n] += w * min(signed, 1.0)
            weight[n] += w
    return total / np.maximum(weight, 1e-30), weight
