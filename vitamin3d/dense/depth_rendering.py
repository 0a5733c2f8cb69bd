# SPDX-License-Identifier: Apache-2.0
"""A denoised triangulation -> depth map and normal map on the canvas, the undistorted camera that holds the whole picture."""

import cv2
import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.config import DepthRenderingConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array, DepthView, Frame, ImageMesh, MapSnapshot


class DepthRenderer:
    """Draws the meshes of one camera on its canvas; what depends on the camera alone is computed once."""

    def __init__(self, camera: Camera, config: DepthRenderingConfig) -> None:
        self.camera = camera
        self.config = config
        whole = camera.canvas(config.canvas_limit)
        share = config.canvas_pixels * camera.width * camera.height / (whole.width * whole.height)
        self.canvas = whole if share >= 1.0 else whole.scaled(float(np.sqrt(share)))
        self._maps = camera.canvas_maps(self.canvas)
        white = np.full((camera.height, camera.width), 255, np.uint8)
        self.is_outside = camera.draw_on_canvas(white, self._maps) < 255

    def draw_gray(self, frame: Frame) -> Array:
        """(H, W) uint8 picture on the canvas; meaningless where `is_outside`."""
        return self.camera.draw_on_canvas(frame.image, self._maps)

    def render(self, snapshot: MapSnapshot, mesh: ImageMesh, slopes: Array) -> DepthView:
        """Depth, normals and colour of a keyframe; `slopes` (V, 2) is the gradient of inverse depth, per pixel of the camera."""
        kept = mesh.triangles[is_surface(mesh, self.camera, self.config)]
        per_canvas_pixel = slopes * (self.camera.intrinsics[:2] / self.canvas.intrinsics[:2])
        layers = np.column_stack([mesh.inverse_depth, per_canvas_pixel, mesh.relative_deviation])
        drawn = rasterize(self.camera.ideal_in(self.canvas, mesh.pixels), kept, layers, self.canvas.width, self.canvas.height)
        drawn[self.is_outside, 0] = 0.0
        depth, normals = depth_and_normals(drawn[..., :3], self.canvas)
        weights = inverse_variances(depth, drawn[..., 3])
        color, at = self._draw_color(snapshot.frame), (snapshot.frame.timestamp_ns, snapshot.T_cam_world)
        return DepthView(*at, depth, normals, color, weights, map_number=snapshot.map_number)

    def _draw_color(self, frame: Frame) -> Array:
        image = frame.image if frame.color is None else frame.color
        drawn = self.camera.draw_on_canvas(image, self._maps)
        return drawn if drawn.ndim == 3 else np.asarray(cv2.cvtColor(drawn, cv2.COLOR_GRAY2RGB))


@kernel
def _weigh(depth, deviations, weights):  # type: ignore[no-untyped-def]
    for v in range(depth.shape[0]):
        d, relative, out = depth[v], deviations[v], weights[v]
        for u in range(depth.shape[1]):
            deviation = d[u] * relative[u]
            out[u] = 1.0 / (deviation * deviation) if deviation > 0.0 else 0.0


def inverse_variances(depth: Array, relative_deviations: Array) -> Array:
    """(H, W) float32 `1 / (depth * relative deviation)²`, per squared map unit; 0 where there is no depth."""
    weights = np.empty(depth.shape, np.float32)
    _weigh(depth, relative_deviations, weights)
    return weights


def is_surface(mesh: ImageMesh, camera: Camera, config: DepthRenderingConfig) -> Array:
    """(F,) bool: triangles that may be a surface; not those that span a depth edge, are seen at a grazing angle or are huge."""
    points = camera.rays_from_ideal(mesh.pixels) / mesh.inverse_depth[:, None]
    kept = np.empty(len(mesh.triangles), np.bool_)
    longest, cosine = config.max_edge_ratio * camera.width, float(np.cos(np.deg2rad(config.max_slant_deg)))
    _keep(mesh.pixels, mesh.inverse_depth, points, mesh.triangles, config.max_inverse_depth_range, longest, cosine, kept)
    return kept


@inlined
def _slant_cosine(points, a, b, c):  # type: ignore[no-untyped-def]
    """Between the normal of a triangle in space and the ray to its centre: 1 seen from the front, 0 edge on."""
    px, py, pz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    qx, qy, qz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    x, y = points[a, 0] + points[b, 0] + points[c, 0], points[a, 1] + points[b, 1] + points[c, 1]
    z = points[a, 2] + points[b, 2] + points[c, 2]
    length = np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + z * z))
    return abs(nx * x + ny * y + nz * z) / max(length, 1e-300)


@kernel
def _keep(pixels, inverse_depth, points, triangles, max_range, max_edge, min_cosine, kept):  # type: ignore[no-untyped-def]
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        za, zb, zc = inverse_depth[a], inverse_depth[b], inverse_depth[c]
        is_smooth = max(za, max(zb, zc)) - min(za, min(zb, zc)) <= max_range * (za + zb + zc) / 3.0
        longest = 0.0
        for i, j in ((a, b), (b, c), (c, a)):
            longest = max(longest, (pixels[i, 0] - pixels[j, 0]) ** 2 + (pixels[i, 1] - pixels[j, 1]) ** 2)
        kept[f] = is_smooth and longest <= max_edge * max_edge and _slant_cosine(points, a, b, c) >= min_cosine


@inlined
def _plane(layers, a, b, c, k, bu, bv, cu, cv):  # type: ignore[no-untyped-def]
    """A layer's value at the first corner and its change along u and v."""
    by_b, by_c = layers[b, k] - layers[a, k], layers[c, k] - layers[a, k]
    return layers[a, k], cv * by_b - bv * by_c, bu * by_c - cu * by_b


@inlined
def _end(slope, sign):  # type: ignore[no-untyped-def]
    """A line of this slope along u reaches a height at height * the first + the second, where it enters (sign 1) or leaves (-1)
    what lies above; a line that does not is far away."""
    return (1.0 / slope, 0.0) if slope * sign > 1e-12 else (0.0, -1e9 * sign)


@kernel
def _rasterize(pixels, triangles, layers, first, second, third, fourth):  # type: ignore[no-untyped-def]
    """Scanlines; each of four layers is affine inside a triangle, the largest in the first one (the nearest surface) wins."""
    height, width = first.shape
    slack = 1e-9
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        au, av = pixels[a, 0], pixels[a, 1]
        bu, bv, cu, cv = pixels[b, 0] - au, pixels[b, 1] - av, pixels[c, 0] - au, pixels[c, 1] - av
        area = bu * cv - bv * cu
        if not abs(area) > 1e-12:
            continue
        top = max(0, int(np.ceil(av + min(0.0, min(bv, cv)))))
        bottom = min(height - 1, int(np.floor(av + max(0.0, max(bv, cv)))))
        left = max(0, int(np.ceil(au + min(0.0, min(bu, cu)))))
        right = min(width - 1, int(np.floor(au + max(0.0, max(bu, cu)))))
        bu, bv, cu, cv = bu / area, bv / area, cu / area, cv / area
        p, p_u, p_v = _plane(layers, a, b, c, 0, bu, bv, cu, cv)
        q, q_u, q_v = _plane(layers, a, b, c, 1, bu, bv, cu, cv)
        r, r_u, r_v = _plane(layers, a, b, c, 2, bu, bv, cu, cv)
        w, w_u, w_v = _plane(layers, a, b, c, 3, bu, bv, cu, cv)
        s_in, s_from = _end(cv, 1.0)
        t_in, t_from = _end(-bv, 1.0)
        r_in, r_from = _end(bv - cv, 1.0)
        s_out, s_to = _end(cv, -1.0)
        t_out, t_to = _end(-bv, -1.0)
        r_out, r_to = _end(bv - cv, -1.0)
        for v in range(top, bottom + 1):
            y = v - av
            hs, ht, hr = y * cu - slack, -y * bu - slack, y * (bu - cu) - 1.0 - slack
            begin = au + max(hs * s_in + s_from, max(ht * t_in + t_from, hr * r_in + r_from))
            end = au + min(hs * s_out + s_to, min(ht * t_out + t_to, hr * r_out + r_to))
            for u in range(max(left, int(np.ceil(begin))), min(right, int(np.floor(end))) + 1):
                x = u - au
                nearness = np.float32(p + x * p_u + y * p_v)
                if nearness > first[v, u]:
                    first[v, u], second[v, u] = nearness, q + x * q_u + y * q_v
                    third[v, u], fourth[v, u] = r + x * r_u + y * r_v, w + x * w_u + y * w_v


def rasterize(pixels: Array, triangles: Array, layers: Array, width: int, height: int) -> Array:
    """Image (height, width, L) float32 of vertex values `layers` (V, L), L <= 4, linear inside each triangle; 0 where there is none.

    Args:
        pixels: (V, 2) positions in this image.
        triangles: (F, 3) int32.
        layers: the first is the inverse depth, which decides where triangles overlap.

    In memory one layer comes after the other.
    """
    count = layers.shape[1]
    values, out = np.zeros((len(layers), 4)), np.zeros((4, height, width), np.float32)
    values[:, :count] = layers
    _rasterize(np.ascontiguousarray(pixels, np.float64), triangles, values, *out)
    return np.moveaxis(out[:count], 0, 2)


@kernel
def _shade(xi, slope_u, slope_v, intrinsics, depth, normals):  # type: ignore[no-untyped-def]
    """The plane <n, X> = 1 has the inverse depth <n, ray>: its gradient gives n_x / fx and n_y / fy, n_z is what remains."""
    fx, fy, cx, cy = intrinsics
    one, none = np.float32(1.0), np.float32(0.0)
    for v in range(xi.shape[0]):
        y, nearness, across, down, far, normal = (np.float32(v) - cy) / fy, xi[v], slope_u[v], slope_v[v], depth[v], normals[v]
        for u in range(xi.shape[1]):
            is_there = nearness[u] > none
            nx, ny = across[u] * fx, down[u] * fy
            nz = nearness[u] - across[u] * (np.float32(u) - cx) - ny * y
            scale = -one / np.sqrt(nx * nx + ny * ny + nz * nz) if is_there else none
            far[u] = one / nearness[u] if is_there else none
            normal[u, 0], normal[u, 1], normal[u, 2] = nx * scale, ny * scale, nz * scale


def depth_and_normals(layers: Array, canvas: Camera) -> tuple[Array, Array]:
    """Depth (H, W) float32 and unit normals (H, W, 3) float32 in the camera frame, towards the camera; 0 where there is none.

    Args:
        layers: (H, W, 3) float32 inverse depth and its gradient per pixel, `[xi, d xi / du, d xi / dv]`; xi = 0 where there is nothing.
    """
    depth, normals = np.empty(layers.shape[:2], np.float32), np.empty((*layers.shape[:2], 3), np.float32)
    xi, slope_u, slope_v = (np.ascontiguousarray(layers[..., k], np.float32) for k in range(3))
    _shade(xi, slope_u, slope_v, canvas.intrinsics.astype(np.float32), depth, normals)
    return depth, normals
