# SPDX-License-Identifier: Apache-2.0
"""Sequences of 16-bit pictures that use a part of their range keep their contrast, with one gain for all of them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from vitamin3d.datasets import open_dataset
from vitamin3d.datasets.base import DEPTH_SAMPLES, PictureSequence
from vitamin3d.datasets.sixteen_bits import FULL_RANGE, WHITE, eight_bits, largest_shown, white_level
from vitamin3d.types import Array

SIZE = (48, 64)
CALIBRATION = "intrinsics: [60, 60, 31.5, 23.5]\ndistortion_coefficients: [0, 0, 0, 0]\nresolution: [64, 48]\nrate_hz: 20\n"
T0 = 1_403_715_284_312_143_104


def scene(brightest: float, seed: int = 0) -> Array:
    """(H, W) uint16 with values up to `brightest`."""
    noise = np.random.default_rng(seed).uniform(0, 1, SIZE)
    return np.asarray(brightest * noise).astype(np.uint16)


def write(path: Path, pixels: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


def euroc(root: Path, pictures: list[Array]) -> Path:
    names = [str(T0 + 50_000_000 * i) for i in range(len(pictures))]
    for name, pixels in zip(names, pictures, strict=True):
        write(root / f"mav0/cam0/data/{name}.png", pixels)
    (root / "mav0/cam0/data.csv").write_text("#t,name\n" + "".join(f"{name},{name}.png\n" for name in names))
    (root / "mav0/cam0/sensor.yaml").write_text(CALIBRATION)
    return root


def tum(root: Path, pictures: list[Array]) -> Path:
    for i, pixels in enumerate(pictures):
        write(root / f"rgb/{i}.png", pixels)
    (root / "rgb.txt").write_text("".join(f"{i}.5 rgb/{i}.png\n" for i in range(len(pictures))))
    (root / "camera.yaml").write_text(CALIBRATION)
    return root


def images(root: Path, pictures: list[Array], suffix: str = "png") -> Path:
    for i, pixels in enumerate(pictures):
        write(root / f"{i}.{suffix}", pixels)
    (root / "camera.yaml").write_text(CALIBRATION)
    return root


def opened(source: Path) -> PictureSequence:
    dataset = open_dataset(source)
    assert isinstance(dataset, PictureSequence)
    return dataset


def grey(dataset: PictureSequence, index: int) -> Array:
    frame = dataset.read(index)
    assert hasattr(frame, "image") and frame.image.dtype == np.uint8
    return np.asarray(frame.image)


def levels(dataset: PictureSequence, index: int) -> int:
    return len(np.unique(grey(dataset, index)))


READERS = [euroc, tum, images]


@pytest.mark.parametrize("make", READERS)
@pytest.mark.parametrize("brightest", [6553, 1966, 4095, 1023, 255, 60])
def test_a_part_of_the_range_is_stretched(tmp_path: Path, make: Callable[[Path, list[Array]], Path], brightest: int) -> None:
    pictures = [scene(brightest, seed) for seed in range(12)]
    dataset = opened(make(tmp_path, pictures))
    for i, pixels in enumerate(pictures):
        assert abs(np.percentile(grey(dataset, i), 99.5) - WHITE) <= 5
        assert levels(dataset, i) >= min(200, len(np.unique(pixels)))
        np.testing.assert_allclose(grey(dataset, i), pixels * (WHITE / dataset._white), atol=0.51)  # rounded
    (remark,) = dataset.remarks
    shown = largest_shown(dataset._white)
    assert remark == f"16-bit pictures: values up to {shown} are shown as 8 bits" and abs(shown / brightest - 1.1) < 0.1


@pytest.mark.parametrize("make", READERS)
@pytest.mark.parametrize("brightest", [65535, 50_000, 35_000])
def test_the_full_range_is_divided_by_256(tmp_path: Path, make: Callable[[Path, list[Array]], Path], brightest: int) -> None:
    pictures = [scene(brightest, seed) for seed in range(3)]
    dataset = opened(make(tmp_path, pictures))
    for i, pixels in enumerate(pictures):
        np.testing.assert_array_equal(grey(dataset, i), pixels // 256)
    assert dataset.remarks == []


@pytest.mark.parametrize("suffix", ["tif", "tiff", "pgm"])
def test_other_formats(tmp_path: Path, suffix: str) -> None:
    dataset = opened(images(tmp_path, [scene(4095), scene(4095, 1)], suffix))
    assert levels(dataset, 0) > 200 and len(dataset.remarks) == 1


def test_colours_share_the_gain(tmp_path: Path) -> None:
    bgr = np.dstack([scene(4000, seed) // (seed + 1) for seed in range(3)])
    dataset = opened(images(tmp_path, [bgr, bgr]))
    frame = dataset.read(0)
    assert hasattr(frame, "color") and frame.color is not None
    np.testing.assert_allclose(frame.color[..., ::-1], np.minimum(bgr * (WHITE / dataset._white), 255), atol=0.51)


def test_eight_bits_are_untouched(tmp_path: Path) -> None:
    pictures = [scene(20, seed).astype(np.uint8) for seed in range(3)]
    dataset = opened(images(tmp_path, pictures))
    np.testing.assert_array_equal(grey(dataset, 1), pictures[1])
    assert dataset.remarks == []


def test_one_gain_for_the_sequence(tmp_path: Path) -> None:
    """The exposure rises to three times its value: nothing is cut off, and brightness stays in proportion."""
    pictures = [scene(2000 * (1 + i / 10), seed=4) for i in range(21)]
    dataset = opened(euroc(tmp_path, pictures))
    gains = [float(np.median(grey(dataset, i)) / np.median(pixels)) for i, pixels in enumerate(pictures)]
    np.testing.assert_allclose(gains, gains[0], rtol=0.02)
    assert grey(dataset, 20).max() <= 235 and levels(dataset, 0) > 70


def test_the_order_of_reading_changes_nothing(tmp_path: Path) -> None:
    source = euroc(tmp_path, [scene(1500 + 200 * i, i) for i in range(10)])
    forward, backward = opened(source), opened(source)
    there = [grey(forward, i) for i in range(10)]
    back = [grey(backward, i) for i in reversed(range(10))][::-1]
    np.testing.assert_array_equal(there, back)
    assert forward.remarks == backward.remarks


@pytest.mark.parametrize("odd", [0, 40, FULL_RANGE])
@pytest.mark.parametrize("at", [0, 10, 19])
def test_a_black_or_white_picture(tmp_path: Path, odd: int, at: int) -> None:
    """It is among the samples where it is the first or last."""
    pictures = [scene(2000, seed) for seed in range(20)]
    pictures[at] = np.full(SIZE, odd, np.uint16)
    dataset = opened(tum(tmp_path, pictures))
    assert levels(dataset, 5) > 50 and len(dataset.remarks) == 1


def test_mostly_black() -> None:
    """Noise of a covered lens is not what the gain is for."""
    assert abs(white_level([scene(30, seed) for seed in range(6)] + [scene(4095), scene(4095, 1)]) - 4075) < 50


def test_unreadable_samples_do_not_matter(tmp_path: Path) -> None:
    source = images(tmp_path, [scene(4095, seed) for seed in range(9)])
    for name in ("0", "8"):
        (source / f"{name}.png").write_bytes(b"no picture")
    write(source / "4.png", np.full((10, 10), FULL_RANGE, np.uint16))
    dataset = opened(source)
    assert levels(dataset, 1) > 200 and len(dataset.remarks) == 1


def test_mixed_depths(tmp_path: Path) -> None:
    """12 bits between JPEGs: the samples are sought where 16 bits can be."""
    source = images(tmp_path, [scene(200, seed).astype(np.uint8) for seed in range(30)], "jpg")
    write(source / "30.png", scene(4095))
    write(source / "31.png", scene(255).astype(np.uint8))
    dataset = opened(source)
    assert levels(dataset, 30) > 200
    np.testing.assert_array_equal(grey(dataset, 31), scene(255))


def test_few_pictures_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, seen = images(tmp_path, [scene(4095, seed) for seed in range(40)]), list[int]()
    monkeypatch.setattr("vitamin3d.datasets.base.white_level", lambda samples: seen.append(len(list(samples))) or FULL_RANGE)
    dataset = opened(source)
    for i in range(len(dataset)):
        dataset.read(i)
    assert seen == [DEPTH_SAMPLES] and dataset.remarks == []


def test_no_samples_or_only_black_ones() -> None:
    assert white_level([]) == FULL_RANGE and white_level([np.zeros(SIZE, np.uint16)]) == FULL_RANGE


@pytest.mark.parametrize("white", [10, 1000, 30_000, FULL_RANGE])
def test_the_mapping_is_monotonic_and_ends_at_white(white: int) -> None:
    shown = eight_bits(np.arange(FULL_RANGE + 1, dtype=np.uint16), white).astype(int)
    assert (np.diff(shown) >= 0).all() and shown[0] == 0 and shown[-1] == 255
    assert shown[largest_shown(white)] >= 253 and (white == FULL_RANGE or shown[white] == WHITE)
