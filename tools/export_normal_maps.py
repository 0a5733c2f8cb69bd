# SPDX-License-Identifier: Apache-2.0
"""Casts the mesh of a finished run into normal maps, one per keyframe (the paper's Fig. 3d).

    python tools/export_normal_maps.py OUT --mesh high --every 5

The pictures are on the run's canvas (OUT/depth/canvas.yaml), so they lie exactly over OUT/depth/<time>.png. Camera frame:
right is red, up is green, towards the camera is blue. World frame: x, y, z of the map are red, green, blue.
"""

import argparse
import sys
from pathlib import Path

from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import InputError, OutputError, Vitamin3dError
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.normal_map import NormalCaster, write_normal_map
from vitamin3d.geometry.se3 import inverse


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of a finished run")
    parser.add_argument("--mesh", choices=("low", "high"), default="high")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th keyframe")
    parser.add_argument("--frame", choices=("camera", "world"), default="camera", help="in which the normals are coloured")
    parser.add_argument("--output", type=Path, help="folder; default: normals_mesh_<mesh> in OUT")
    return parser.parse_args(argv)


def export(arguments: argparse.Namespace) -> Path:
    """Reads the mesh, the keyframes and the canvas, writes a picture for every N-th keyframe; their folder."""
    if arguments.every < 1:
        raise InputError(f"--every: must be positive, not {arguments.every}")
    caster = NormalCaster(read_ply(arguments.out / f"mesh_{arguments.mesh}.ply"))
    canvas = read_calibration(arguments.out / "depth" / "canvas.yaml").camera
    keyframes = read_tum(arguments.out / "keyframes.tum")
    folder = _made(arguments.output or arguments.out / f"normals_mesh_{arguments.mesh}")
    for k in range(0, len(keyframes), arguments.every):
        T_world_cam, time_ns = keyframes.T_world_cam[k], int(keyframes.timestamps_ns[k])
        normals_cam = caster.cast(canvas, inverse(T_world_cam))
        R_frame_cam = T_world_cam[:3, :3] if arguments.frame == "world" else None
        write_normal_map(normals_cam, folder / f"{time_ns // 10**9}.{time_ns % 10**9:09d}.png", R_frame_cam)
    return folder


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another --output") from None
    return folder


def main(argv: list[str] | None = None) -> int:
    try:
        print(export(parsed(argv)))
    except Vitamin3dError as error:
        print(f"export_normal_maps: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
