# SPDX-License-Identifier: Apache-2.0
"""Small sequences as each kind of source has them, and what a test asks of a dataset."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from vitamin3d.datasets import Dataset, Unreadable, open_dataset
from vitamin3d.errors import InputError
from vitamin3d.types import Frame, Trajectory

T0 = 1_403_715_284_312_143_104
CALIBRATION = "intrinsics: [60, 60, 31.5, 23.5]\ndistortion_coefficients: [0, 0, 0, 0]\nresolution: [64, 48]\n"
TURNED = "T_BS: {data: [0, -1, 0, 0.5, 1, 0, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]}\n"


def draw(path: Path, level: int = 100, size: tuple[int, int] = (64, 48), color: bool = False) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((size[1], size[0]), level, np.uint8)
    assert cv2.imwrite(str(path), np.dstack([pixels, pixels // 2, pixels]) if color else pixels)
    return path


def calibration(tmp_path: Path, text: str = CALIBRATION) -> Path:
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    return path


def euroc(tmp_path: Path, count: int = 3) -> Path:
    root = tmp_path / "sequence"
    times = [T0 + 50_000_000 * i for i in range(count)]
    for i, time in enumerate(times):
        draw(root / f"mav0/cam0/data/{time}.png", 10 * i)
    (root / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\r\n" + "".join(f"{t},{t}.png\r\n" for t in times), newline="")
    (root / "mav0/cam0/sensor.yaml").write_text("%YAML:1.0\n" + CALIBRATION + TURNED)
    states = root / "mav0/state_groundtruth_estimate0/data.csv"
    states.parent.mkdir()
    states.write_text("#t,p,q\n" + "".join(f"{t},1.0,2.0,{i},0.5,0.5,-0.5,0.5,0,0,0\n" for i, t in enumerate(times)))
    return root


def tum(tmp_path: Path) -> Path:
    root = tmp_path / "tum"
    for i in range(3):
        draw(root / f"rgb/{i}.png", 10 * i, color=True)
    (root / "rgb.txt").write_text("# timestamp filename\n1.000000001 rgb/0.png\n1.033333 rgb/1.png\n1.066666 rgb/2.png\n")
    (root / "camera.yaml").write_text(CALIBRATION)
    (root / "groundtruth.txt").write_text("# t\n1.0 1 2 3 0 0 0 1\n1.1 1 2 3 0.5 0.5 0.5 0.5\n")
    return root


def kitti(tmp_path: Path, folder: str = "image_0") -> Path:
    root = tmp_path / "00"
    for i in range(3):
        draw(root / folder / f"{i:06d}.png", 10 * i)
    (root / "times.txt").write_text("0.000000e+00\n1.036224e-01\n2.0e-01\n")
    (root / "calib.txt").write_text("P0: 60 0 31 0 0 60 23 0 0 0 1 0\nP2: 61 0 31 5 0 61 23 0 0 0 1 0\n")
    (root / "poses.txt").write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(3)))
    return root


def images(tmp_path: Path, names: list[str]) -> Path:
    for i, name in enumerate(names):
        draw(tmp_path / "pictures" / name, 10 * i)
    return tmp_path / "pictures"


def video(tmp_path: Path, name: str = "clip.avi", count: int = 8, fps: float = 29.97) -> Path:
    path = tmp_path / name
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (64, 48))
    for i in range(count):
        writer.write(np.full((48, 64, 3), 25 * i % 250, np.uint8))
    writer.release()
    return path


def frame(dataset: Dataset, index: int) -> Frame:
    read = dataset.read(index)
    assert isinstance(read, Frame)
    return read


def reason(dataset: Dataset, index: int) -> str:
    read = dataset.read(index)
    assert isinstance(read, Unreadable)
    return read.reason


def truth(dataset: Dataset) -> Trajectory:
    trajectory = dataset.ground_truth()
    assert trajectory is not None
    return trajectory


def message(source: Path, calibration_file: Path | None = None) -> str:
    with pytest.raises(InputError) as caught:
        open_dataset(source, calibration_file)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write_picture(path, value=80):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((480, 640), value, np.uint8))


def write_depth(path, counts):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((480, 640), counts, np.uint16))
