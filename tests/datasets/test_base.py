# SPDX-License-Identifier: Apache-2.0
"""What all lists of pictures have in common."""

from pathlib import Path

from sequences import CALIBRATION, calibration, draw, euroc, frame, kitti, message, reason, truth, tum

from vitamin3d.datasets import open_dataset


def test_a_calibration_overrides(tmp_path: Path) -> None:
    other = calibration(tmp_path, CALIBRATION.replace("[60, 60", "[70, 70"))
    for source in (euroc(tmp_path), tum(tmp_path), kitti(tmp_path)):
        assert open_dataset(source, other).camera.fx == 70.0
    assert truth(open_dataset(euroc(tmp_path / "again"), other)).T_world_cam.shape == (3, 4, 4)


def test_a_missing_or_odd_picture_is_one_bad_frame(tmp_path: Path) -> None:
    root = tum(tmp_path)
    (root / "rgb/0.png").unlink()
    draw(root / "rgb/2.png", size=(32, 24))
    dataset = open_dataset(root)
    assert reason(dataset, 0) == "the file is missing"
    assert reason(dataset, 2) == "it is 32×24 pixels, the calibration is for 64×48"
    assert frame(dataset, 1).index == 1


def test_an_odd_first_picture(tmp_path: Path) -> None:
    root = tum(tmp_path)
    draw(root / "rgb/0.png", size=(32, 24))
    assert reason(open_dataset(root), 0).startswith("it is 32×24")


def test_pictures_of_another_size(tmp_path: Path) -> None:
    for name in ("0", "1", "2"):
        draw(tum(tmp_path) / f"rgb/{name}.png")
    other = calibration(tmp_path, CALIBRATION.replace("[64, 48]", "[128, 96]").replace("[60, 60", "[120, 120"))
    text = message(tum(tmp_path), other)
    assert "the pictures are 64×48, the calibration is for 128×96; calibrate at the pictures' size" in text
