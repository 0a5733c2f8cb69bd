# SPDX-License-Identifier: Apache-2.0
"""Each kind of source is recognised, read and, where it is wrong, refused in one line."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from vitamin3d.datasets import Dataset, Unreadable, kind_of, open_dataset
from vitamin3d.errors import InputError
from vitamin3d.geometry.se3 import rotation_from_quaternion
from vitamin3d.types import Frame, Trajectory

SHARED = Path(__file__).parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no sequences in {SHARED}")
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


# EuRoC


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


def test_a_calibration_overrides(tmp_path: Path) -> None:
    other = calibration(tmp_path, CALIBRATION.replace("[60, 60", "[70, 70"))
    for source in (euroc(tmp_path), tum(tmp_path), kitti(tmp_path)):
        assert open_dataset(source, other).camera.fx == 70.0
    assert truth(open_dataset(euroc(tmp_path / "again"), other)).T_world_cam.shape == (3, 4, 4)


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


# TUM


def test_tum(tmp_path: Path) -> None:
    dataset = open_dataset(tum(tmp_path))
    assert dataset.timestamps_ns.tolist() == [1_000_000_001, 1_033_333_000, 1_066_666_000]
    color = frame(dataset, 1).color
    assert color is not None and color.shape == (48, 64, 3)
    assert truth(dataset).timestamps_ns.tolist() == [1_000_000_000, 1_100_000_000]
    np.testing.assert_allclose(truth(dataset).T_world_cam[1, :3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_tum_mistakes(tmp_path: Path) -> None:
    root = tum(tmp_path)
    (root / "rgb.txt").write_text("1.0 rgb/0.png\n0.9 rgb/1.png\n")
    assert "rgb.txt, line 2: time 0.900000000 s is before that of the line above" in message(root)
    (root / "rgb.txt").write_text("1.0 rgb/0.png\nrgb/1.png 2.0\n")
    assert "rgb.txt, line 2: expected a time in seconds" in message(root)
    (root / "camera.yaml").unlink()
    assert "no calibration" in message(root)


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


# KITTI


@pytest.mark.parametrize(("folder", "focal"), [("image_0", 60.0), ("image_2", 61.0)])
def test_kitti(tmp_path: Path, folder: str, focal: float) -> None:
    dataset = open_dataset(kitti(tmp_path, folder))
    assert (dataset.camera.fx, dataset.camera.width, dataset.camera.height) == (focal, 64, 48)
    assert dataset.timestamps_ns.tolist() == [0, 103_622_400, 200_000_000]
    np.testing.assert_array_equal(truth(dataset).T_world_cam[:, 0, 3], [0, 1, 2])


def test_kitti_other_truth(tmp_path: Path) -> None:
    root = kitti(tmp_path)
    (root / "poses.txt").unlink()
    assert open_dataset(root).ground_truth() is None
    (root / "groundtruth.tum").write_text("0 1 2 3 0 0 0 1\n")
    assert len(truth(open_dataset(root))) == 1


def test_kitti_mistakes(tmp_path: Path) -> None:
    root = kitti(tmp_path)
    (root / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    with pytest.raises(InputError, match=r"poses.txt, line 4: more poses than the 3 times"):
        open_dataset(root).ground_truth()
    (root / "times.txt").write_text("0\n1\n")
    assert "times.txt: 2 times for 3 pictures" in message(root)
    (root / "times.txt").write_text("0\n1\n1\n")
    assert "times.txt, line 3: time 1.000000000 s is equal to" in message(root)
    (root / "times.txt").write_text("0\n1\n2\n")
    (root / "calib.txt").unlink()
    assert "no calibration" in message(root)


# Folders of pictures


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


# Videos


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


# Nothing that can be opened


def missing(tmp_path: Path) -> Path:
    return tmp_path / "none"


def a_text(tmp_path: Path) -> Path:
    return calibration(tmp_path)


def a_picture(tmp_path: Path) -> Path:
    return draw(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("make", "expected"),
    [(missing, "no such file or folder"), (a_text, "not a video (.avi, .mkv, .mov, .mp4)"), (a_picture, "a single picture")],
)
def test_no_source(tmp_path: Path, make: Callable[[Path], Path], expected: str) -> None:
    text = message(make(tmp_path))
    assert expected in text and text.startswith(str(tmp_path))


# The real sequences


@pytest.mark.shared
@needs_shared
@pytest.mark.parametrize(
    ("name", "count", "poses", "color"),
    [
        ("room1_v101_easy", 700, 700, False),
        ("euroc_v101_start", 40, 60, False),
        ("kitchen", 1000, 1000, True),
        ("desk", 900, 0, True),
        ("kitti00", 200, 200, False),
    ],
)
def test_shared(name: str, count: int, poses: int, color: bool) -> None:
    dataset = open_dataset(SHARED / name)
    assert (dataset.name, len(dataset)) == (name, count)
    last = frame(dataset, count - 1)
    assert (last.color is not None) == color
    assert last.image.shape == (dataset.camera.height, dataset.camera.width)
    trajectory = dataset.ground_truth()
    assert (0 if trajectory is None else len(trajectory)) == poses
