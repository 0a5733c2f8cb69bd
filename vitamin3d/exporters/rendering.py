# SPDX-License-Identifier: Apache-2.0
"""Pictures of meshes and clouds without a window: rays for meshes, a z-buffer of discs for points, any viewpoint."""

from collections.abc import Sequence

import cv2
import numpy as np

from vitamin3d.errors import OutputError
from vitamin3d.exporters.normal_map import NormalCaster, rgb_from_normals
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import transform_points
from vitamin3d.types import Array

BACKGROUND = np.array([255, 255, 255])
AMBIENT = 0.35
NEAR_COLOR, FAR_COLOR = np.array([20.0, 40.0, 90.0]), np.array([150.0, 190.0, 230.0])
"""Of points without colours, by depth."""
LABEL_HEIGHT, GAP = 26, 6


def viewer(canvas: Camera, width: int) -> Camera:
    """The canvas camera, scaled to a picture of this width."""
    return canvas.scaled(width / canvas.width)


def stepped_aside(T_cam_world: Array, target_depth: float, right: float, up: float, back: float) -> Array:
    """T_cam_world of a viewer who stepped aside, in lengths of the world, and looks at the point straight ahead of before."""
    target, eye = np.array([0.0, 0.0, target_depth]), np.array([right, -up, -back])
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T_view_cam = np.eye(4)
    T_view_cam[:3, :3] = np.stack([x, np.cross(z, x), z])
    T_view_cam[:3, 3] = -T_view_cam[:3, :3] @ eye
    return np.asarray(T_view_cam @ T_cam_world)


def draw(caster: NormalCaster, camera: Camera, T_cam_world: Array, shading: str) -> Array:
    """(H, W, 3) uint8 picture of the mesh, lit from the viewer; shading: color, clay or normals."""
    normals = caster.cast(camera, T_cam_world)
    hit = (normals != 0).any(axis=-1)
    if shading == "normals":
        picture = rgb_from_normals(normals)
    else:
        base = caster.cast_colors(camera, T_cam_world) if shading == "color" else np.full(normals.shape, 225.0)
        picture = base * (AMBIENT + (1.0 - AMBIENT) * np.abs(normals[..., 2:]))
    return np.where(hit[..., None], picture, BACKGROUND).clip(0, 255).astype(np.uint8)


def draw_points(points: Array, colors: Array | None, camera: Camera, T_cam_world: Array, radius_px: float = 1.5) -> Array:
    """(H, W, 3) uint8 picture of points (N, 3) as discs, the nearest in front; points without colours fade with depth.

    The camera's distortion is not used: give the canvas.
    """
    cam = transform_points(T_cam_world, points)
    front = cam[:, 2] > 1e-6
    cam, pixels = cam[front], camera.ideal_from_points(cam[front])
    near = np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e6).all(axis=1)
    cam, pixels = cam[near], pixels[near]
    tints = _tints(cam[:, 2]) if colors is None else colors[front][near].astype(np.float64)
    reach = np.arange(-int(radius_px), int(radius_px) + 1)
    offsets = np.array([(u, v) for u in reach for v in reach if u * u + v * v <= radius_px * radius_px])
    u, v = (np.rint(pixels)[:, None, :] + offsets).reshape(-1, 2).astype(np.int64).T
    rows = np.repeat(np.arange(len(cam)), len(offsets))
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    order = np.argsort(-cam[rows[inside], 2], kind="stable")  # far ones first: near ones paint over them
    picture = np.tile(BACKGROUND.astype(np.uint8), (camera.height, camera.width, 1))
    picture[v[inside][order], u[inside][order]] = tints[rows[inside][order]].clip(0, 255).astype(np.uint8)
    return np.asarray(picture)


def _tints(depth: Array) -> Array:
    """Colours (N, 3) by depth, from dark for the nearest to light for the farthest tenth."""
    if len(depth) == 0:
        return np.zeros((0, 3))
    low, high = np.percentile(depth, [5, 90])
    share = np.clip((depth - low) / max(high - low, 1e-12), 0.0, 1.0)[:, None]
    return np.asarray((1 - share) * NEAR_COLOR + share * FAR_COLOR)


def reduced(picture: Array, factor: int) -> Array:
    """A picture (H, W, 3) uint8 made smaller by averaging blocks of `factor`² pixels."""
    height, width = (n // factor for n in picture.shape[:2])
    blocks = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.asarray(blocks.mean(axis=(1, 3)).astype(np.uint8))


def side_by_side(panels: Sequence[Array], labels: Sequence[str], columns: int = 3) -> Array:
    """Panels (H, W, 3) of one size with their labels above, row by row, white between."""
    height, width = panels[0].shape[:2]
    cells = [_labelled(panel, label) for panel, label in zip(panels, labels, strict=True)]
    columns = min(columns, len(cells))
    rows = -(-len(cells) // columns)
    page = np.full((rows * (height + LABEL_HEIGHT + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for k, cell in enumerate(cells):
        v, u = (k // columns) * (height + LABEL_HEIGHT + GAP), (k % columns) * (width + GAP)
        page[v : v + cell.shape[0], u : u + width] = cell
    return page


def _labelled(panel: Array, label: str) -> Array:
    head = np.full((LABEL_HEIGHT, panel.shape[1], 3), 255, np.uint8)
    cv2.putText(head, label, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack([head, panel])


def jpeg(picture: Array, quality: int = 85) -> bytes:
    """A picture (H, W, 3) RGB or (H, W) grey uint8 as JPEG."""
    ordered = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    ok, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise OutputError(f"OpenCV could not encode a picture {picture.shape} {picture.dtype} as JPEG")
    return bytes(data.tobytes())
