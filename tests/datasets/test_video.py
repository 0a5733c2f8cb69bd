# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest
from sequences import CALIBRATION, calibration, frame, message, reason, video

from vitamin3d.datasets import open_dataset


@pytest.mark.parametrize("name", ["clip.avi", "clip.mkv"])
def test_video(tmp_path: Path, name: str) -> None:
    dataset = open_dataset(video(tmp_path, name), calibration(tmp_path))
    assert (dataset.name, len(dataset)) == ("clip", 8)
    assert dataset.timestamps_ns.tolist() == [round(i * 10**11 / 2997) for i in range(8)]
    for index in (0, 0, 1, 5, 2, 7, 6):
        read = frame(dataset, index)
        assert (read.index, read.timestamp_ns, read.image.shape) == (index, round(index * 10**11 / 2997), (48, 64))
        assert abs(float(read.image.mean()) - 25 * index) < 3
    assert dataset.ground_truth() is None and dataset.path_of(3).name == name


def test_video_cut_off(tmp_path: Path) -> None:
    source = video(tmp_path, count=20)
    data = source.read_bytes()
    frames = [i for i in range(len(data)) if data.startswith(b"\xff\xd8\xff", i)]
    source.write_bytes(data[: frames[12]])
    dataset = open_dataset(source, calibration(tmp_path))
    assert frame(dataset, 3).index == 3
    assert reason(dataset, len(dataset) - 1) == f"frame {len(dataset) - 1} cannot be decoded; the video may be cut off"
    source.write_bytes(b"")
    assert "not a video that OpenCV can decode" in message(source, calibration(tmp_path))


def test_video_mistakes(tmp_path: Path) -> None:
    source = video(tmp_path)
    assert "no calibration" in message(source)
    other = calibration(tmp_path, CALIBRATION.replace("[64, 48]", "[48, 64]"))
    assert "the pictures are 64×48, the calibration is for 48×64" in message(source, other)
    assert "only one picture" in message(video(tmp_path, count=1), calibration(tmp_path))
