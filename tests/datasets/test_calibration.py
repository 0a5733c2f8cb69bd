# SPDX-License-Identifier: Apache-2.0
"""Calibration files: what is read, and each mistake by its name."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from vitamin3d.datasets.calibration import read_calibration, read_kitti_calibration
from vitamin3d.errors import InputError

GOOD = {
    "resolution": "[64, 48]",
    "intrinsics": "[60.5, 61, 31.5, 23.5]  # fu, fv, cu, cv",
    "distortion_model": "radial-tangential",
    "distortion_coefficients": "[-0.28, 0.07, 0.0002, 1e-5]",
}


def written(tmp_path: Path, **changes: str | None) -> Path:
    fields = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    path = tmp_path / "camera.yaml"
    path.write_text("%YAML:1.0\n---\n" + "".join(f"{key}: {value}\n" for key, value in fields.items()))
    return path


def message(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_calibration(path)
    text = str(caught.value)
    assert "\n" not in text and text.startswith(str(path))
    return text


def test_a_good_file(tmp_path: Path) -> None:
    calibration = read_calibration(written(tmp_path, rate_hz="29.97", camera_model="pinhole"))
    camera = calibration.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (60.5, 61.0, 31.5, 23.5, 64, 48)
    assert camera.distortion == (-0.28, 0.07, 0.0002, 1e-5)
    assert calibration.rate_hz == Fraction(2997, 100) and calibration.T_body_cam is None


def test_extrinsics(tmp_path: Path) -> None:
    T = "{rows: 4, cols: 4, data: [0, -1, 0, 0.5, 1, 0, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]}"
    T_body_cam = read_calibration(written(tmp_path, T_BS=T)).T_body_cam
    assert T_body_cam is not None
    np.testing.assert_array_equal(T_body_cam[:3, 3], [0.5, 2, 3])


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"intrinsics": None}, "`intrinsics` is missing"),
        ({"resolution": None}, "`resolution` is missing"),
        ({"distortion_coefficients": None}, "`distortion_coefficients` is missing"),
        ({"intrinsics": "[60, 60, 32]"}, "`intrinsics` must be 4 numbers, found 3"),
        ({"intrinsics": "60"}, "`intrinsics` must be 4 numbers, found 60"),
        ({"intrinsics": "[60, abc, 32, 24]"}, "`intrinsics` must be 4 finite numbers"),
        ({"intrinsics": "[60, .nan, 32, 24]"}, "`intrinsics` must be 4 finite numbers"),
        ({"intrinsics": "[60, true, 32, 24]"}, "`intrinsics` must be 4 finite numbers"),
        ({"intrinsics": "[-60, 60, 32, 24]"}, "focal lengths must be positive"),
        ({"intrinsics": "[60, 0, 32, 24]"}, "focal lengths must be positive"),
        ({"intrinsics": "[0.9, 0.9, 0.5, 0.5]"}, "they are in pixels"),
        ({"intrinsics": "[60, 20, 32, 24]"}, "focal lengths 60 and 20"),
        ({"intrinsics": "[60, 60, 320, 240]"}, "the principal point (320, 240) is far outside the 64×48 picture"),
        ({"distortion_coefficients": "[0, 0, 0, 0, 0]"}, "`distortion_coefficients` must be 4 numbers, found 5"),
        ({"distortion_coefficients": "[-30, 0, 0, 0]"}, "folds"),
        ({"distortion_model": "equidistant"}, "distortion_model 'equidistant' is unknown"),
        ({"camera_model": "omni"}, "camera_model 'omni' is unknown"),
        ({"resolution": "[64.5, 48]"}, "two positive integers"),
        ({"resolution": "[0, 48]"}, "two positive integers"),
        ({"rate_hz": "0"}, "`rate_hz` must be a positive number"),
        ({"rate_hz": "fast"}, "`rate_hz` must be a positive number"),
        ({"T_BS": "{data: [1, 2]}"}, "`data` must be 16 numbers, found 2"),
        ({"T_BS": "{data: [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}"}, "not a rigid transform"),
        ({"intrinsics": "[60, 60"}, "not a YAML file"),
    ],
)
def test_mistakes(tmp_path: Path, changes: dict[str, str | None], expected: str) -> None:
    assert expected in message(written(tmp_path, **changes))


def test_no_fields(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("just text")
    assert "no fields" in message(path)
    path.write_bytes(b"\xff\x00\xfe")
    assert "not a text file" in message(path)
    path.unlink()
    assert "cannot be read" in message(path)


def test_kitti(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text("P0: 718 0 607 0 0 719 185 0 0 0 1 0\nP2: 1 2\n")
    camera = read_kitti_calibration(path, "P0", (1241, 376))
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.is_distorted) == (718, 719, 607, 185, False)
    with pytest.raises(InputError, match="line 2: expected twelve numbers, found 2"):
        read_kitti_calibration(path, "P2", (1241, 376))
    with pytest.raises(InputError, match="no line `P1:`"):
        read_kitti_calibration(path, "P1", (1241, 376))
