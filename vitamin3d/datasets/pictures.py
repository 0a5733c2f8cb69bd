# SPDX-License-Identifier: Apache-2.0
"""Reading one picture file, and noticing where it is damaged (OpenCV decodes half a JPEG without a word)."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.datasets.sixteen_bits import FULL_RANGE, eight_bits
from vitamin3d.types import Array

PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})
DEEP_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".pgm", ".ppm"})
"""Those that can hold 16 bits."""
DECODE = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
"""The sensor's own grid: a rotation tag changes nothing, since the calibration belongs to the grid."""


@dataclass(frozen=True)
class Picture:
    """A decoded picture."""

    grey: Array
    """(H, W) uint8."""
    color: Array | None
    """(H, W, 3) uint8 RGB, None where the picture is grey."""


@dataclass(frozen=True)
class Unreadable:
    """A picture that cannot be used, and why; a value, since one bad file does not end a sequence."""

    path: Path
    reason: str


def read_picture(path: Path) -> Picture | Unreadable:
    """Decodes a picture file; 16-bit values are divided by 256, alpha is dropped."""
    pixels = read_pixels(path)
    return pixels if isinstance(pixels, Unreadable) else picture_of(pixels)


def read_pixels(path: Path) -> Array | Unreadable:
    """The values of a picture file, (H, W) or (H, W, 3) BGR, uint8 or uint16."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return Unreadable(path, "the file is missing")
    except OSError as error:
        return Unreadable(path, f"the file cannot be read ({error.strerror})")
    if not data:
        return Unreadable(path, "the file is empty")
    if is_truncated(data):
        return Unreadable(path, "the file is cut off")
    pixels = _decode(data)
    if pixels is None:
        return Unreadable(path, "the file is damaged or not a picture")
    return pixels if pixels.dtype in (np.uint8, np.uint16) else Unreadable(path, f"its pixels are {pixels.dtype}, not 8 or 16 bits")


def picture_of(pixels: Array, white: int = FULL_RANGE) -> Picture:
    """Picture of pixels (H, W) or (H, W, 3) BGR, uint8, or uint16 of a sequence with this white level."""
    if pixels.dtype == np.uint16:
        pixels = eight_bits(pixels, white)
    if pixels.ndim == 2:
        return Picture(pixels, None)
    if np.array_equal(pixels[..., 0], pixels[..., 1]) and np.array_equal(pixels[..., 1], pixels[..., 2]):
        return Picture(np.ascontiguousarray(pixels[..., 0]), None)
    return Picture(np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)), np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)))


def is_truncated(data: bytes) -> bool:
    """True for a JPEG, PNG or binary PGM / PPM without its end."""
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" not in data[_start_of_scan(data) :]
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data
    if data[:2] in (b"P5", b"P6"):
        return _is_netpbm_truncated(data)
    return False


def _start_of_scan(data: bytes) -> int:
    """Where the JPEG's pixels begin: behind all headers, whose thumbnail has an end marker of its own."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF and data[position + 1] != 0xDA:
        is_fill = data[position + 1] == 0xFF
        position += 1 if is_fill else 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return position


def _is_netpbm_truncated(data: bytes) -> bool:
    """True where a binary PGM / PPM holds fewer bytes than its header (`P5 width height max`) says."""
    header = b" ".join(line.split(b"#")[0] for line in data[:512].splitlines()).split()[1:4]
    if len(header) < 3 or not all(word.isdigit() for word in header):
        return True
    width, height, largest = (int(word) for word in header)
    return len(data) < width * height * (3 if data[:2] == b"P6" else 1) * (2 if largest > 255 else 1)


def _decode(data: bytes) -> Array | None:
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), DECODE)
    except cv2.error:
        return None
    return None if pixels is None else np.asarray(pixels)
