# SPDX-License-Identifier: Apache-2.0
"""Picture files: grey, colour, depth of bits, damage."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from vitamin3d.datasets.pictures import Picture, Unreadable, read_picture
from vitamin3d.types import Array

FORMATS = ["jpg", "jpeg", "png", "bmp", "tif", "tiff", "webp", "pgm", "ppm"]


def smooth_picture(channels: int = 3) -> Array:
    noise = np.random.default_rng(1).integers(0, 255, (24, 32, channels), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0))


def encoded(pixels: Array, suffix: str) -> bytes:
    done, data = cv2.imencode(f".{suffix}", pixels)
    assert done
    return data.tobytes()


def readable(path: Path) -> Picture:
    picture = read_picture(path)
    assert isinstance(picture, Picture)
    return picture


def reason(path: Path) -> str:
    picture = read_picture(path)
    assert isinstance(picture, Unreadable) and picture.path == path
    return picture.reason


@pytest.mark.parametrize("suffix", FORMATS)
def test_formats(tmp_path: Path, suffix: str) -> None:
    pixels = smooth_picture()[..., 0] if suffix == "pgm" else smooth_picture()
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(encoded(pixels, suffix))
    picture = readable(path)
    assert picture.grey.shape == (24, 32) and picture.grey.dtype == np.uint8
    assert (picture.color is None) == (suffix == "pgm")


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("share", [0.98, 0.6, 0.1])
def test_cut_files(tmp_path: Path, suffix: str, share: float) -> None:
    data = encoded(smooth_picture()[..., 0] if suffix == "pgm" else smooth_picture(), suffix)
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(data[: int(share * len(data))])
    assert reason(path) in ("the file is cut off", "the file is damaged or not a picture")


def test_color_is_rgb(tmp_path: Path) -> None:
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 2] = 200
    (tmp_path / "a.png").write_bytes(encoded(red, "png"))
    color = readable(tmp_path / "a.png").color
    assert color is not None
    np.testing.assert_array_equal(color[0, 0], [200, 0, 0])


def test_three_equal_channels_are_grey(tmp_path: Path) -> None:
    grey = smooth_picture()[..., 0]
    (tmp_path / "a.png").write_bytes(encoded(np.dstack([grey] * 3), "png"))
    picture = readable(tmp_path / "a.png")
    assert picture.color is None
    np.testing.assert_array_equal(picture.grey, grey)


def test_alpha_is_dropped(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encoded(smooth_picture(4), "png"))
    color = readable(tmp_path / "a.png").color
    assert color is not None and color.shape == (24, 32, 3)


def test_sixteen_bits(tmp_path: Path) -> None:
    deep = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 80
    (tmp_path / "a.png").write_bytes(encoded(deep, "png"))
    picture = readable(tmp_path / "a.png")
    np.testing.assert_array_equal(picture.grey, deep // 256)


def test_other_pixels_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.tiff").write_bytes(encoded(np.zeros((8, 8), np.float32), "tiff"))
    assert "float32" in reason(tmp_path / "a.tiff")


def test_a_thumbnail_does_not_hide_the_cut(tmp_path: Path) -> None:
    """An EXIF thumbnail has an end marker of its own, in front of the picture."""
    data, thumbnail = encoded(smooth_picture(), "jpg"), encoded(smooth_picture()[:8, :8], "jpg")
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:2] + segment + data[2:])
    assert readable(path)
    path.write_bytes((data[:2] + segment + data[2:])[:-20])
    assert reason(path) == "the file is cut off"


def test_bytes_behind_the_end_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(encoded(smooth_picture(), "jpg") + bytes(5000))
    assert readable(path)


def test_netpbm_comments(tmp_path: Path) -> None:
    path = tmp_path / "a.pgm"
    path.write_bytes(b"P5\n# made by hand\n4 3\n255\n" + bytes(12))
    assert readable(path).grey.shape == (3, 4)


def test_no_picture(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "empty.png").touch()
    (tmp_path / "folder.png").mkdir()
    assert reason(tmp_path / "none.png") == "the file is missing"
    assert reason(tmp_path / "empty.png") == "the file is empty"
    assert reason(tmp_path / "text.png") == "the file is damaged or not a picture"
    assert reason(tmp_path / "folder.png").startswith("the file cannot be read")
