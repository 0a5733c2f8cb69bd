# SPDX-License-Identifier: Apache-2.0
"""Draws the mesh of a finished run as a PNG, headless.

    python tools/render_mesh.py OUT picture.png
    python tools/render_mesh.py OUT picture.png --keyframe 40 --back 0.8 --up 0.3 --shading normals

Without --keyframe the keyframe in the middle is taken. The viewer may step back and up from there, by that many median
depths of the picture, and looks at the same place.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.exporters.depth_map import write_png
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.normal_map import NormalCaster, rgb_from_normals
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array

BACKGROUND = np.array([255, 255, 255])
AMBIENT = 0.35


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of a finished run")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--mesh", choices=("low", "high"), default="high")
    parser.add_argument("--keyframe", type=int)
    parser.add_argument("--back", type=float, default=0.0, help="median depths to step back")
    parser.add_argument("--up", type=float, default=0.0, help="median depths to step up")
    parser.add_argument("--right", type=float, default=0.0, help="median depths to step to the right")
    parser.add_argument("--width", type=int, default=1200)
    parser.add_argument("--shading", choices=("color", "clay", "normals"), default="color")
    return parser.parse_args(argv)


def viewer(canvas: Camera, width: int) -> Camera:
    """The canvas camera, scaled to a picture of this width."""
    s = width / canvas.width
    return Camera(canvas.fx * s, canvas.fy * s, (canvas.cx + 0.5) * s - 0.5, (canvas.cy + 0.5) * s - 0.5, width, round(canvas.height * s))


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
    """(H, W, 3) uint8 picture of the mesh, lit from the viewer."""
    normals, colors = caster.cast(camera, T_cam_world), caster.cast_colors(camera, T_cam_world)
    hit = (normals != 0).any(axis=-1)
    if shading == "normals":
        picture = rgb_from_normals(normals)
    else:
        base = colors if shading == "color" else np.full(colors.shape, 225.0)
        picture = base * (AMBIENT + (1.0 - AMBIENT) * np.abs(normals[..., 2:]))
    return np.where(hit[..., None], picture, BACKGROUND).clip(0, 255).astype(np.uint8)


def main(argv: list[str] | None = None) -> int:
    """Reads the run, draws, writes; 2 with one line for bad input."""
    arguments = parsed(argv)
    try:
        write_png(_picture(arguments), arguments.picture)
    except Vitamin3dError as error:
        print(f"render_mesh: {error}", file=sys.stderr)
        return 2
    print(arguments.picture)
    return 0


def _picture(arguments: argparse.Namespace) -> Array:
    out = arguments.out
    keyframes = read_tum(out / "keyframes.tum")
    canvas = read_calibration(out / "depth" / "canvas.yaml").camera
    k = len(keyframes) // 2 if arguments.keyframe is None else arguments.keyframe
    if not 0 <= k < len(keyframes):
        raise InputError(f"--keyframe {k}: {out} has the keyframes 0 to {len(keyframes) - 1}")
    caster, T_cam_world = NormalCaster(read_ply(out / f"mesh_{arguments.mesh}.ply")), inverse(keyframes.T_world_cam[k])
    depth = caster.median_depth(canvas, T_cam_world)
    moved = stepped_aside(T_cam_world, depth, arguments.right * depth, arguments.up * depth, arguments.back * depth)
    double = viewer(canvas, 2 * arguments.width)
    picture = draw(caster, double, moved, arguments.shading)
    return np.asarray(cv2.resize(picture, (double.width // 2, double.height // 2), interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    sys.exit(main())
