# SPDX-License-Identifier: Apache-2.0
"""Makes a picture of a run: tracked extrema over a frame, the mesh, and its normal maps at both voxel sizes (Fig. 3).

vitamin3d reconstruct SOURCE -o OUT --save-tracks
python tools/make_readme_figures.py SOURCE OUT picture.jpg --keyframe 60 --back 0.3 --up 0.2
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.datasets import open_dataset
from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import Vitamin3dError
from vitamin3d.evaluation.paper_figure import tracked_extrema
from vitamin3d.exporters.files import write_file
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.normal_map import NormalCaster
from vitamin3d.exporters.rendering import draw, stepped_aside, viewer
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array

GAP = 6
JPEG_QUALITY = 90


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--keyframe", type=int, default=0)
    parser.add_argument("--back", type=float, default=0.0)
    parser.add_argument("--up", type=float, default=0.0)
    parser.add_argument("--without-picture", action="store_true", help="the extrema alone, where the picture may not be shown")
    parser.add_argument("--width", type=int, default=600, help="of each panel")
    return parser.parse_args(argv)


def panels(arguments: argparse.Namespace) -> list[Array]:
    """Extrema, coloured mesh, normals of the fine and of the coarse mesh; each (H, W, 3) RGB of one size."""
    keyframes = read_tum(arguments.out / "keyframes.tum")
    canvas = read_calibration(arguments.out / "depth" / "canvas.yaml").camera
    T_cam_world = inverse(keyframes.T_world_cam[arguments.keyframe])
    fine, coarse = (NormalCaster(read_ply(arguments.out / f"mesh_{name}.ply")) for name in ("high", "low"))
    depth = fine.median_depth(canvas, T_cam_world)
    T_view = stepped_aside(T_cam_world, depth, 0.0, arguments.up * depth, arguments.back * depth)
    double = viewer(canvas, 2 * arguments.width)
    size = (arguments.width, double.height // 2)
    dataset, time = open_dataset(arguments.source, arguments.calibration), int(keyframes.timestamps_ns[arguments.keyframe])
    extrema = tracked_extrema(arguments.out, dataset, time, size, not arguments.without_picture)
    drawn = [
        draw(fine, double, T_view, "color"),
        draw(fine, double, T_view, "normals"),
        draw(coarse, double, T_view, "normals"),
    ]
    return [extrema, *(np.asarray(cv2.resize(panel, size, interpolation=cv2.INTER_AREA)) for panel in drawn)]


def page(four: list[Array]) -> Array:
    """Two by two, white between."""
    a, b, c, d = (np.pad(panel, ((GAP, 0), (GAP, 0), (0, 0)), constant_values=255) for panel in four)
    return np.vstack([np.hstack([a, b]), np.hstack([c, d])])[GAP:, GAP:]


def main(argv: list[str] | None = None) -> int:
    """Draws and writes; 2 with one line for bad input."""
    arguments = parsed(argv)
    try:
        picture = cv2.cvtColor(page(panels(arguments)), cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(arguments.picture.suffix, picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        write_file(arguments.picture, [data.tobytes()])
    except Vitamin3dError as error:
        print(f"make_readme_figures: {error}", file=sys.stderr)
        return 2
    print(arguments.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
