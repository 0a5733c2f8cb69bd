# SPDX-License-Identifier: Apache-2.0
"""The figures that the paper prints (Tables 1 to 3), to stand beside measured ones.

Table 1 per sequence and method: cm (mean, deviation), success rate % (mean, deviation), initialisation retries (mean,
deviation). V203 of VITAMIN-E is printed as 14.0 cm, a typing error: the authors' slides and the paper's conclusion say 140.0.
"""

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One cell of Table 1."""

    cm: tuple[float, float]
    success: tuple[float, float]
    """Percent."""
    retries: tuple[float, float] | None = None


METHODS = ("VITAMIN-E (paper)", "DSO", "ORB-SLAM", "LSD-SLAM")


def _row(*cells: tuple[float, float, float, float, float | None, float | None]) -> dict[str, Published]:
    made = [Published((a, b), (c, d), None if e is None or f is None else (e, f)) for a, b, c, d, e, f in cells]
    return dict(zip(METHODS, made, strict=True))


N = None
_FULL = (100.0, 0.0, 0, 0)
"""All pictures localised, no retry."""
# fmt: off
TABLE_1 = {
    "MH01": _row((12.9, 0.5, *_FULL), (6.0, 0.8, *_FULL), (5.2, 1.1, 97.7, 1.6, 19, 11), (44.9, 7.2, 28.9, 23.6, N, N)),
    "MH02": _row((8.8, 0.5, *_FULL), (4.2, 0.2, *_FULL), (4.1, 0.4, 92.4, 1.1, 56, 6), (58.3, 6.9, 73.0, 1.5, N, N)),
    "MH03": _row((10.6, 1.3, *_FULL), (21.1, 0.9, *_FULL), (4.5, 0.4, 48.9, 0.8, 0, 0), (266.2, 61.3, 28.4, 20.7, N, N)),
    "MH04": _row((19.3, 1.6, *_FULL), (20.3, 1.0, 95.7, 0.0, 5, 0), (33.6, 9.4, 95.2, 0.8, 6, 1), (136.4, 114.3, 27.2, 7.0, N, N)),
    "MH05": _row((14.7, 1.1, *_FULL), (10.2, 0.6, 95.5, 0.0, 2, 0), (14.9, 4.6, 90.0, 4.0, 18, 5), (27.4, 16.4, 22.7, 0.5, N, N)),
    "V101": _row((9.7, 0.2, *_FULL), (13.4, 5.8, *_FULL), (8.8, 0.1, 96.6, 0.0, 1, 0), (20.0, 22.8, 11.6, 11.2, N, N)),
    "V102": _row((9.3, 0.6, *_FULL), (53.0, 5.5, *_FULL), (14.5, 11.7, 52.0, 3.3, 17, 4), (67.0, 14.0, 15.2, 0.1, N, N)),
    "V103": _row((11.3, 0.5, *_FULL), (85.0, 36.4, *_FULL), (37.2, 20.7, 65.5, 8.8, 56, 26), (29.3, 2.0, 11.0, 0.1, N, N)),
    "V201": _row((7.5, 0.4, *_FULL), (7.6, 0.5, *_FULL), (6.0, 0.1, 95.2, 0.0, 0, 0), (131.3, 20.4, 74.1, 8.9, N, N)),
    "V202": _row((8.6, 0.7, *_FULL), (11.8, 1.4, *_FULL), (12.3, 2.7, 99.5, 1.2, 0, 0), (42.1, 9.2, 11.3, 0.2, N, N)),
    "V203": _row((140.0, 5.2, *_FULL), (147.5, 6.6, *_FULL), (104.3, 64.0, 16.8, 15.9, 233, 123), (17.7, 1.6, 11.9, 0.2, N, N)),
}
# fmt: on

TABLE_2_MS = {"VITAMIN-E (paper)": 36.0, "DSO": 53.0, "ORB-SLAM": 25.0, "LSD-SLAM": 30.0}
"""Tracking, per frame, on a Core i7-7820HQ."""

TABLE_3_MS = {
    "feature tracking, per frame": 36.0,
    "localisation and mapping, per frame": 25.0,
    "meshing and denoising, per keyframe": 45.0,
    "TSDF and marching cubes, 15 cm, per time": 175.0,
    "TSDF and marching cubes, 2.5 cm, per time": 4000.0,
}


def euroc_name(name: str) -> str | None:
    """`MH01` of `MH_01_easy`, `V203` of `V2_03_difficult`; None for what is not one of EuRoC's own sequences."""
    found = re.match(r"(?:MH_?0?(\d)|V(\d)_?0(\d))(?![0-9])", name, re.IGNORECASE)
    if found is None:
        return None
    key = f"MH0{found[1]}" if found[1] else f"V{found[2]}0{found[3]}"
    return key if key in TABLE_1 else None
