# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest
from sequences import CALIBRATION, T0, calibration, euroc, frame, message, truth

from vitamin3d.datasets import kind_of, open_dataset
from vitamin3d.errors import InputError
from vitamin3d.geometry.se3 import rotation_from_quaternion


@pytest.mark.parametrize("below", ["", "mav0", "mav0/cam0"])
def test_euroc(tmp_path: Path, below: str) -> None:
    source = euroc(tmp_path) / below
    dataset = open_dataset(source)
    assert (kind_of(source), dataset.name, len(dataset)) == ("euroc", "sequence", 3)
    assert dataset.timestamps_ns.tolist() == [T0, T0 + 50_000_000, T0 + 100_000_000]
    assert (frame(dataset, 2).timestamp_ns, frame(dataset, 2).index, frame(dataset, 2).color) == (T0 + 100_000_000, 2, None)
    assert dataset.path_of(1).name == f"{T0 + 50_000_000}.png"


def test_euroc_truth_is_of_the_camera(tmp_path: Path) -> None:
    poses = truth(open_dataset(euroc(tmp_path)))
    assert poses.timestamps_ns[0] == T0 and len(poses) == 3
    R_world_body = rotation_from_quaternion(np.array([0.5, -0.5, 0.5, 0.5]))
    np.testing.assert_allclose(poses.T_world_cam[2, :3, :3], R_world_body @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(poses.T_world_cam[2, :3, 3], np.array([1, 2, 2]) + R_world_body @ [0.5, 2, 3], atol=1e-12)


def test_euroc_without_truth_or_extrinsics(tmp_path: Path) -> None:
    root = euroc(tmp_path)
    (root / "mav0/cam0/sensor.yaml").write_text(CALIBRATION)
    with pytest.raises(InputError, match="no `T_BS`"):
        open_dataset(root).ground_truth()
    (root / "mav0/state_groundtruth_estimate0/data.csv").unlink()
    assert open_dataset(root).ground_truth() is None


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ("5,5.png\n5,6.png\n", "data.csv, line 3: time 0.000000005 s is equal to"),
        ("5,5.png\n4,6.png\n", "data.csv, line 3: time 0.000000004 s is before"),
        ("5.5,5.png\n", "data.csv, line 2: expected a time in integer nanoseconds, found '5.5'"),
        ("5\n", "data.csv, line 2: expected `timestamp_ns filename`"),
        ("", "no pictures"),
        ("5,5.png\n", "only one picture"),
        ("5,5.png\n6,6.png\n", "none of its 2 pictures can be read"),
    ],
)
def test_euroc_lists(tmp_path: Path, rows: str, expected: str) -> None:
    root = euroc(tmp_path)
    (root / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n" + rows)
    assert expected in message(root)


def test_euroc_missing_parts(tmp_path: Path) -> None:
    root = euroc(tmp_path)
    (root / "mav0/cam0/sensor.yaml").unlink()
    assert "no calibration; give --calibration FILE" in message(root)
    (root / "mav0/cam0/data.csv").unlink()
    assert "data.csv: cannot be read" in message(root, calibration(tmp_path))
