# SPDX-License-Identifier: Apache-2.0
"""Selects the points of a cloud by what is known about them.

    python tools/filter_cloud.py OUT/cloud.ply good.ply --min-parallax 5 --max-rms 1
    python tools/filter_cloud.py OUT/cloud.ply sure.ply --max-deviation 0.02 --min-observations 6

Parallax in degrees, RMS of the reprojection error in pixels, deviation of the depth relative to the depth. The filter is
written into the comments of the new file.
"""

import argparse
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np

from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.exporters.mesh import read_cloud_ply, write_cloud_ply
from vitamin3d.types import Array, PointCloud


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cloud", type=Path, help="cloud.ply of a run")
    parser.add_argument("output", type=Path)
    parser.add_argument("--min-parallax", type=float, default=0.0, metavar="DEGREES")
    parser.add_argument("--max-rms", type=float, default=np.inf, metavar="PIXELS")
    parser.add_argument("--max-deviation", type=float, default=np.inf, metavar="SHARE", help="of the depth")
    parser.add_argument("--min-observations", type=int, default=0, metavar="N")
    return parser.parse_args(argv)


def is_good(cloud: PointCloud, arguments: argparse.Namespace) -> Array:
    """(N,) bool: the points that pass."""
    good = (cloud.parallax_deg >= arguments.min_parallax) & (cloud.reprojection_rms_px <= arguments.max_rms)
    good &= (cloud.depth_deviation <= arguments.max_deviation) & (cloud.num_observations >= arguments.min_observations)
    return np.asarray(good)


def run(arguments: argparse.Namespace) -> str:
    """Reads, selects, writes; how many points passed."""
    cloud, comments = read_cloud_ply(arguments.cloud)
    good = is_good(cloud, arguments)
    if not good.any():
        raise InputError(f"{arguments.cloud}: none of the {len(good)} points passes; loosen the limits")
    remark = (
        f"filter_cloud: parallax from {arguments.min_parallax:g} degrees, RMS up to {arguments.max_rms:g} px, "
        f"deviation up to {arguments.max_deviation:g}, at least {arguments.min_observations} observations"
    )
    selected = PointCloud(*(getattr(cloud, field.name)[good] for field in fields(PointCloud)))
    write_cloud_ply(selected, arguments.output, [*comments, remark])
    return f"{arguments.output}: {int(good.sum())} of {len(good)} points"


def main(argv: list[str] | None = None) -> int:
    """Prints one line; 2 for bad input."""
    try:
        print(run(parsed(argv)))
    except Vitamin3dError as error:
        print(f"filter_cloud: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
