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
from vitamin3d.exporters.normal_map import NormalCaster
from vitamin3d.exporters.rendering import draw, stepped_aside, viewer
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array


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
