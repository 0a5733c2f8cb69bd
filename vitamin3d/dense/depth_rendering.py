# SPDX-License-Identifier: Apache-2.0
"""A denoised triangulation -> depth map and normal map on the canvas, the undistorted camera that holds the whole picture."""

import cv2
import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import DepthRenderingConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.types import Array, DepthView, Frame, ImageMesh, MapSnapshot


class DepthRenderer:
    """Draws the meshes of one camera on its canvas; what depends on the camera alone is computed once."""

    def __init__(self, camera: Camera, config: DepthRenderingConfig) -> None:
        self.camera = camera
        self.config = config
        self.canvas = camera.canvas(config.canvas_limit)
        self._maps = camera.canvas_maps(self.canvas)
        white = np.full((camera.height, camera.width), 255, np.uint8)
        self.is_outside = camera.draw_on_canvas(white, self._maps) < 255

    def draw_gray(self, frame: Frame) -> Array:
        """(H, W) uint8 picture on the canvas; meaningless where `is_outside`."""
        return self.camera.draw_on_canvas(frame.image, self._maps)

    def render(self, snapshot: MapSnapshot, mesh: ImageMesh, slopes: Array) -> DepthView:
        """Depth, normals and colour of a keyframe; `slopes` (V, 2) is the gradient of inverse depth at the vertices."""
        kept = mesh.triangles[is_surface(mesh, self.camera, self.config)]
        shift = np.array([self.canvas.cx - self.camera.cx, self.canvas.cy - self.camera.cy])
        layers = np.column_stack([mesh.inverse_depth, slopes, mesh.relative_deviation])
        drawn = rasterize(mesh.pixels + shift, kept, layers, self.canvas.width, self.canvas.height)
        drawn[self.is_outside] = 0.0
        depth, normals = depth_and_normals(drawn[..., :3], self.canvas)
        weights = inverse_variances(depth, drawn[..., 3])
        return DepthView(snapshot.frame.timestamp_ns, snapshot.T_cam_world, depth, normals, self._draw_color(snapshot.frame), weights)

    def _draw_color(self, frame: Frame) -> Array:
        image = frame.image if frame.color is None else frame.color
        drawn = self.camera.draw_on_canvas(image, self._maps)
        return drawn if drawn.ndim == 3 else np.asarray(cv2.cvtColor(drawn, cv2.COLOR_GRAY2RGB))


def inverse_variances(depth: Array, relative_deviations: Array) -> Array:
    """(H, W) float32 `1 / (depth * relative deviation)²`, per squared map unit; 0 where there is no depth."""
    deviations = depth * relative_deviations
    return np.asarray(np.divide(1.0, deviations**2, out=np.zeros(depth.shape), where=deviations > 0), np.float32)


def is_surface(mesh: ImageMesh, camera: Camera, config: DepthRenderingConfig) -> Array:
    """(F,) bool: triangles that may be a surface; not those that span a depth edge, are seen at a grazing angle or are huge."""
    corners = mesh.inverse_depth[mesh.triangles]
    is_smooth = np.ptp(corners, axis=1) <= config.max_inverse_depth_range * corners.mean(axis=1)
    a, b, c = (mesh.pixels[mesh.triangles[:, k]] for k in range(3))
    longest = np.sqrt(np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
    is_short = longest <= config.max_edge_ratio * camera.width
    return np.asarray(is_smooth & is_short & (slant_cosines(mesh, camera) >= np.cos(np.deg2rad(config.max_slant_deg))))


def slant_cosines(mesh: ImageMesh, camera: Camera) -> Array:
    """(F,) cosine between the triangle's normal in space and the ray to its centre: 1 seen from the front, 0 edge on."""
    points = camera.rays_from_ideal(mesh.pixels) / mesh.inverse_depth[:, None]
    a, b, c = (points[mesh.triangles[:, k]] for k in range(3))
    normal, center = np.cross(b - a, c - a), a + b + c
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(center, axis=1)
    return np.asarray(np.abs((normal * center).sum(axis=1)) / np.maximum(length, 1e-300))


@kernel
def _rasterize(pixels, triangles, layers, out):  # type: ignore[no-untyped-def]
    """Scanlines; every layer is affine inside a triangle, the largest first layer (the nearest surface) wins."""
    height, width, count = out.shape
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
        for v in range(top, bottom + 1):
            entered = False
            for u in range(left, right + 1):
                s = (u - au) * cv - (v - av) * cu
                t = (v - av) * bu - (u - au) * bv
                if s < -slack or t < -slack or s + t > 1.0 + slack:
                    if entered:
                        break
                    continue
                entered = True
                nearness = (1.0 - s - t) * layers[a, 0] + s * layers[b, 0] + t * layers[c, 0]
                if nearness > out[v, u, 0]:
                    out[v, u, 0] = nearness
                    for k in range(1, count):
                        out[v, u, k] = (1.0 - s - t) * layers[a, k] + s * layers[b, k] + t * layers[c, k]


def rasterize(pixels: Array, triangles: Array, layers: Array, width: int, height: int) -> Array:
    """Image (height, width, L) float64 of vertex values `layers` (V, L), linear inside each triangle; 0 where there is none.

    Args:
        pixels: (V, 2) positions in this image.
        triangles: (F, 3) int32.
        layers: the first is the inverse depth, which decides where triangles overlap.
    """
    out = np.zeros((height, width, layers.shape[1]))
    _rasterize(np.ascontiguousarray(pixels, np.float64), triangles, np.ascontiguousarray(layers, np.float64), out)
    return out


@kernel
def _shade(layers, intrinsics, depth, normals):  # type: ignore[no-untyped-def]
    """The plane <n, X> = 1 has the inverse depth <n, ray>: its gradient gives n_x / fx and n_y / fy, n_z is what remains."""
    fx, fy, cx, cy = intrinsics
    for v in range(layers.shape[0]):
        y = (v - cy) / fy
        for u in range(layers.shape[1]):
            xi = layers[v, u, 0]
            if not xi > 0.0:
                continue
            nx, ny = layers[v, u, 1] * fx, layers[v, u, 2] * fy
            nz = xi - nx * (u - cx) / fx - ny * y
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            depth[v, u] = 1.0 / xi
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = -nx / length, -ny / length, -nz / length


def depth_and_normals(layers: Array, canvas: Camera) -> tuple[Array, Array]:
    """Depth (H, W) float32 and unit normals (H, W, 3) float32 in the camera frame, towards the camera; 0 where there is none.

    Args:
        layers: (H, W, 3) inverse depth and its gradient per pixel, `[xi, d xi / du, d xi / dv]`; xi = 0 where there is nothing.
    """
    depth, normals = np.zeros(layers.shape[:2], np.float32), np.zeros((*layers.shape[:2], 3), np.float32)
    _shade(layers, canvas.intrinsics, depth, normals)
    return depth, normals
