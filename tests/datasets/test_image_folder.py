# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest
from sequences import CALIBRATION, T0, calibration, images, message

from vitamin3d.datasets import open_dataset


@pytest.mark.parametrize(
    ("names", "order", "times"),
    [
        (["a10.png", "a9.jpg", "a1.bmp"], ["a1.bmp", "a9.jpg", "a10.png"], [0, 50_000_000, 100_000_000]),
        (["000001.png", "000000.png"], ["000000.png", "000001.png"], [0, 50_000_000]),
        ([f"{T0 + 7}.png", f"{T0}.png"], [f"{T0}.png", f"{T0 + 7}.png"], [T0, T0 + 7]),
        (["1.9.png", "1.10.png"], ["1.10.png", "1.9.png"], [1_100_000_000, 1_900_000_000]),
        (["1305031102.175304.png", "1305031102.211214.png"], None, [1305031102175304000, 1305031102211214000]),
        (["1.5.png", "b.png"], ["1.5.png", "b.png"], [0, 50_000_000]),
    ],
)
def test_images(tmp_path: Path, names: list[str], order: list[str] | None, times: list[int]) -> None:
    dataset = open_dataset(images(tmp_path, names), calibration(tmp_path, CALIBRATION + "rate_hz: 20\n"))
    assert dataset.timestamps_ns.tolist() == times
    assert [dataset.path_of(i).name for i in range(len(dataset))] == (order or names)
    assert dataset.ground_truth() is None


def test_images_at_the_default_rate(tmp_path: Path) -> None:
    dataset = open_dataset(images(tmp_path, ["a.png", "b.png", "c.png"]), calibration(tmp_path))
    assert dataset.timestamps_ns.tolist() == [0, 33_333_333, 66_666_667]


def test_images_twice_the_same_time(tmp_path: Path) -> None:
    source = images(tmp_path, ["1.5.png", "1.50.png"])
    assert "1.50.png: the same time as 1.5.png" in message(source, calibration(tmp_path))


def test_images_mistakes(tmp_path: Path) -> None:
    source = images(tmp_path, ["a.png"])
    assert "no calibration" in message(source)
    assert "only one picture" in message(source, calibration(tmp_path))
    (source / "a.png").unlink()
    (source / "notes.txt").write_text("no picture")
    (source / "._a.png").write_text("left by a Mac")
    assert "no pictures" in message(source, calibration(tmp_path))
    assert "cannot be read" in message(source, tmp_path / "none.yaml")


def test_images_all_damaged(tmp_path: Path) -> None:
    source = images(tmp_path, ["a.png", "b.png"])
    for path in source.iterdir():
        path.write_bytes(path.read_bytes()[:-20])
    text = message(source, calibration(tmp_path))
    assert "none of its 2 pictures can be read" in text and "the file is cut off" in text
