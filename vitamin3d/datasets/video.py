# SPDX-License-Identifier: Apache-2.0
"""A video file, with a calibration file."""

from fractions import Fraction
from math import isfinite
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.datasets.base import check_count, frame_of, picture_size, wrong_size
from vitamin3d.datasets.calibration import DEFAULT_RATE_HZ, missing_calibration, read_calibration
from vitamin3d.datasets.pictures import Picture, Unreadable, picture_of
from vitamin3d.datasets.tables import regular_timestamps
from vitamin3d.errors import InputError
from vitamin3d.types import Array, Frame, Trajectory

VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv"})
LARGEST_DENOMINATOR = 1001
"""NTSC rates are n / 1001."""


class VideoDataset:
    """The frames of a video, by index. Reading in order is fast; going back starts again from the
    first frame. For one thread at a time."""

    def __init__(self, source: Path, calibration: Path | None = None) -> None:
        if calibration is None:
            raise missing_calibration(source)
        loaded = read_calibration(calibration)
        self.name, self.camera, self._source = source.stem, loaded.camera, source
        self._capture, self._next = _open(source), 0
        self._last: tuple[int, Array | None] = (-1, None)
        rate = _rate(self._capture) or loaded.rate_hz or DEFAULT_RATE_HZ
        self.timestamps_ns = np.array(regular_timestamps(_count(self._capture, source), rate), np.int64)
        check_count(source, len(self.timestamps_ns))
        self._check_size()

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def remarks(self) -> list[str]:
        return []

    def path_of(self, index: int) -> Path:
        return self._source

    def read(self, index: int) -> Frame | Unreadable:
        picture = self._picture(index)
        if picture is None:
            return Unreadable(self._source, f"frame {index} cannot be decoded; the video may be cut off")
        return frame_of(picture, index, self.timestamps_ns, self.camera, self._source)

    def ground_truth(self) -> Trajectory | None:
        return None

    def _picture(self, index: int) -> Picture | None:
        pixels = self._pixels(range(len(self))[index])
        return None if pixels is None else picture_of(pixels)

    def _pixels(self, index: int) -> Array | None:
        if self._last[0] != index:
            self._last = (index, self._decode(index))
        return self._last[1]

    def _decode(self, index: int) -> Array | None:
        """Frame `index`, counted from the start: a video's own seeking is not exact."""
        if index < self._next:
            self._capture, self._next = _open(self._source), 0
        while self._next < index:
            self._capture.grab()
            self._next += 1
        self._next += 1
        good, pixels = self._capture.read()
        return np.asarray(pixels) if good else None

    def _check_size(self) -> None:
        picture = self._picture(0)
        if picture is None:
            raise InputError(f"{self._source}: its first frame cannot be decoded; convert the video to H.264 mp4 or to pictures")
        if picture_size(picture) != (self.camera.width, self.camera.height):
            raise wrong_size(self._source, picture_size(picture), self.camera)


def _open(source: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(source))
    if not capture.isOpened():
        raise InputError(f"{source}: not a video that OpenCV can decode; convert it to H.264 mp4 or to pictures")
    return capture


def _rate(capture: cv2.VideoCapture) -> Fraction | None:
    """Frames per second as a fraction; None where the file does not say."""
    fps = capture.get(cv2.CAP_PROP_FPS)
    return Fraction(fps).limit_denominator(LARGEST_DENOMINATOR) if isfinite(fps) and 0 < fps < 1e5 else None


def _count(capture: cv2.VideoCapture, source: Path) -> int:
    """Number of frames; counted where the file does not say."""
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if count > 0:
        return count
    counter = _open(source)
    while counter.grab():
        count = max(count, 0) + 1
    return max(count, 0)
