# SPDX-License-Identifier: Apache-2.0
"""Calibration files with the fields of EuRoC's `sensor.yaml`; every mistake that can be seen is named."""

from dataclasses import dataclass
from fractions import Fraction
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vitamin3d.datasets.tables import Row, read_text, rows_of
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import Camera, PinholeCamera
from vitamin3d.types import Array

DEFAULT_RATE_HZ = Fraction(30)
MODELS = ("radial-tangential", "radtan", "plumb_bob")
EXAMPLE = "intrinsics: [fu, fv, cu, cv], distortion_coefficients: [k1, k2, p1, p2], resolution: [width, height]"


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says."""

    camera: Camera
    rate_hz: Fraction | None
    T_body_cam: Array | None
    """(4, 4), EuRoC's T_BS."""


def read_calibration(path: Path) -> Calibration:
    """Reads and checks a calibration file; InputError names the file, the field and the remedy."""
    fields = _read_yaml(path)
    _check_models(path, fields)
    fx, fy, cx, cy = _numbers(path, fields, "intrinsics", 4)
    width, height = _resolution(path, fields)
    k1, k2, p1, p2 = _numbers(path, fields, "distortion_coefficients", 4)
    camera = PinholeCamera(fx, fy, cx, cy, width, height, (k1, k2, p1, p2), _readout(path, fields))
    check_camera(path, camera)
    return Calibration(camera, _rate(path, fields), _extrinsics(path, fields))


def missing_calibration(source: Path) -> InputError:
    """The error for a source that brings no calibration and was given none."""
    return InputError(f"{source}: no calibration; give --calibration FILE with the fields {EXAMPLE}")


def read_kitti_calibration(path: Path, line_name: str, size: tuple[int, int]) -> Camera:
    """Camera of KITTI's `calib.txt`: the projection `P0:` or `P2:`, of rectified pictures of the given size."""
    for row in rows_of(path, "name"):
        if row.fields[0] == f"{line_name}:":
            return _kitti_camera(row, size)
    raise InputError(f"{path}: no line `{line_name}:` with twelve numbers; use the calib.txt of this sequence, or give --calibration FILE")


def check_camera(path: Path, camera: PinholeCamera) -> None:
    """InputError for a camera that cannot be meant."""
    fx, fy = camera.fx, camera.fy
    size = max(camera.width, camera.height)
    if min(fx, fy) <= 0:
        raise _bad(path, f"focal lengths must be positive, not {fx:g} and {fy:g}")
    if not (0.1 * size <= fx <= 50 * size and 0.5 < fx / fy < 2.0):
        raise _bad(path, f"focal lengths {fx:g} and {fy:g} cannot be those of a {camera.width}×{camera.height} picture; they are in pixels")
    if abs(camera.cx / camera.width - 0.5) > 1.0 or abs(camera.cy / camera.height - 0.5) > 1.0:
        raise _bad(path, f"the principal point ({camera.cx:g}, {camera.cy:g}) is far outside the {camera.width}×{camera.height} picture")
    if _folds_early(camera):
        raise _bad(path, "the distortion folds the picture onto itself; check distortion_coefficients: [k1, k2, p1, p2]")


def _folds_early(camera: PinholeCamera) -> bool:
    """True where the radial distortion stops growing within half of the picture's shorter side."""
    r2 = (0.25 * min(camera.width / camera.fx, camera.height / camera.fy)) ** 2
    k1, k2 = camera.distortion[:2]
    return 1.0 + 3.0 * k1 * r2 + 5.0 * k2 * r2 * r2 <= 0.0 or max(abs(c) for c in camera.distortion[2:]) > 1.0


def _bad(path: Path, what: str) -> InputError:
    return InputError(f"{path}: {what}; expected {EXAMPLE}")


def _read_yaml(path: Path) -> dict[str, Any]:
    """The fields of a YAML file; OpenCV's first line `%YAML:1.0`, which is not YAML, is left out."""
    lines = [line for line in read_text(path).splitlines() if not line.startswith("%")]
    try:
        fields = yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as error:
        place = getattr(error, "problem_mark", None)
        raise _bad(path, f"not a YAML file{f' (line {place.line + 1})' if place else ''}") from None
    if not isinstance(fields, dict):
        raise _bad(path, "no fields")
    return fields


def _check_models(path: Path, fields: dict[str, Any]) -> None:
    model, lens = fields.get("distortion_model", MODELS[0]), fields.get("camera_model", "pinhole")
    if model not in MODELS:
        raise InputError(f"{path}: distortion_model {model!r} is unknown; calibrate with {MODELS[0]!r} or undistort the pictures first")
    if lens != "pinhole":
        raise InputError(f"{path}: camera_model {lens!r} is unknown; calibrate with 'pinhole' or undistort the pictures first")


def _numbers(path: Path, fields: dict[str, Any], key: str, count: int) -> list[float]:
    """`count` finite numbers of a field; text like `1e-5`, which YAML 1.1 leaves as text, counts."""
    if key not in fields:
        raise _bad(path, f"the field `{key}` is missing")
    values = fields[key]
    if not isinstance(values, list) or len(values) != count:
        found = f"{len(values)}" if isinstance(values, list) else repr(values)
        raise _bad(path, f"`{key}` must be {count} numbers, found {found}")
    try:
        numbers = [float(value) for value in values if not isinstance(value, bool)]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) < count or not all(isfinite(number) for number in numbers):
        raise _bad(path, f"`{key}` must be {count} finite numbers, found {values}")
    return numbers


def _resolution(path: Path, fields: dict[str, Any]) -> tuple[int, int]:
    width, height = _numbers(path, fields, "resolution", 2)
    if width < 1 or height < 1 or width % 1 or height % 1:
        raise _bad(path, f"`resolution` must be two positive integers, found {fields['resolution']}")
    return int(width), int(height)


def _rate(path: Path, fields: dict[str, Any]) -> Fraction | None:
    """Pictures per second as the file writes it, without a float's rounding."""
    if fields.get("rate_hz") is None:
        return None
    try:
        rate = Fraction(str(fields["rate_hz"]))
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 0 < rate <= 10**6:
        raise InputError(f"{path}: `rate_hz` must be a positive number, found {fields['rate_hz']!r}")
    return rate


def _readout(path: Path, fields: dict[str, Any]) -> float:
    """Seconds from the first to the last row of a rolling shutter, negative where the last is read first; 0 where the file has none."""
    if fields.get("readout_s") is None:
        return 0.0
    try:
        seconds = float(fields["readout_s"])
    except (TypeError, ValueError):
        seconds = float("nan")
    if not abs(seconds) < 1.0:
        raise InputError(f"{path}: `readout_s` must be the seconds from the first to the last row, found {fields['readout_s']!r}")
    return seconds


def _extrinsics(path: Path, fields: dict[str, Any]) -> Array | None:
    """T_BS (4, 4) of the field `T_BS: {rows, cols, data}`; None where the file has none."""
    if "T_BS" not in fields:
        return None
    table = fields["T_BS"]
    T = np.reshape(_numbers(path, table if isinstance(table, dict) else {"data": table}, "data", 16), (4, 4))
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{path}: `T_BS` is not a rigid transform; write the 4×4 matrix row by row")
    return T


def _kitti_camera(row: Row, size: tuple[int, int]) -> Camera:
    numbers = row.numbers(row.fields[1:])
    if len(numbers) != 12:
        raise row.fail(f"expected twelve numbers, found {len(numbers)}")
    P = np.reshape(numbers, (3, 4))
    camera = PinholeCamera(float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]), *size)
    check_camera(row.path, camera)
    return camera
