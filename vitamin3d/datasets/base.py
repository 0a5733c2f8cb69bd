# SPDX-License-Identifier: Apache-2.0
"""What a source of pictures must offer, and the part that all sources made of picture files share."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from vitamin3d.datasets.pictures import DEEP_SUFFIXES, Picture, Unreadable, picture_of, read_picture, read_pixels
from vitamin3d.datasets.sixteen_bits import FULL_RANGE, largest_shown, white_level
from vitamin3d.errors import InputError
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array, Frame, Trajectory

SIZE_SAMPLES = 50
"""Pictures looked at before all of them are said to have the wrong size."""
DEPTH_SAMPLES = 8
"""Pictures spread over the sequence that say which part of 16 bits is in use."""


class Dataset(Protocol):
    """A sequence of pictures of one calibrated camera."""

    @property
    def name(self) -> str: ...

    @property
    def camera(self) -> Camera: ...

    @property
    def timestamps_ns(self) -> Array:
        """(T,) int64, strictly ascending."""
        ...

    @property
    def remarks(self) -> list[str]:
        """What was done to the pictures that the user should know, a line each."""
        ...

    def __len__(self) -> int: ...

    def read(self, index: int) -> Frame | Unreadable:
        """The frame, or why its picture cannot be used: the caller warns, counts and goes on."""
        ...

    def path_of(self, index: int) -> Path: ...

    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world poses in the source's own world and units, or None where the source has none."""
        ...


@dataclass(frozen=True)
class Listing:
    """Pictures and their times, as a source names them; not opened yet."""

    timestamps_ns: list[int]
    paths: list[Path]


class PictureSequence:
    """A dataset of picture files; the sources differ in how they list the files and where the truth lies."""

    def __init__(self, source: Path, camera: Camera, listing: Listing) -> None:
        """Raises InputError where there are no two pictures, none is readable, or none fits the calibration."""
        self.name = source.resolve().name
        self.camera = camera
        self.timestamps_ns = np.array(listing.timestamps_ns, np.int64)
        self._paths = tuple(listing.paths)
        check_count(source, len(self._paths))
        self._check_pictures(source)

    def __len__(self) -> int:
        return len(self._paths)

    def path_of(self, index: int) -> Path:
        return self._paths[index]

    def read(self, index: int) -> Frame | Unreadable:
        path = self._paths[index]
        pixels = read_pixels(path)
        if isinstance(pixels, Unreadable):
            return pixels
        picture = picture_of(pixels, self._white if pixels.dtype == np.uint16 else FULL_RANGE)
        return frame_of(picture, index, self.timestamps_ns, self.camera, path)

    @property
    def remarks(self) -> list[str]:
        return [] if self._white == FULL_RANGE else [f"16-bit pictures: values up to {largest_shown(self._white)} are shown as 8 bits"]

    @cached_property
    def _white(self) -> int:
        """The white level of the sequence's 16-bit pictures: the files alone decide, whichever is read first."""
        return white_level(self._deep_samples())

    def _deep_samples(self) -> Iterator[Array]:
        paths = [path for path in self._paths if path.suffix.lower() in DEEP_SUFFIXES]
        size = self.camera.height, self.camera.width
        for i in np.linspace(0, len(paths) - 1, min(DEPTH_SAMPLES, len(paths))).astype(int):
            pixels = read_pixels(paths[i])
            if not isinstance(pixels, Unreadable) and pixels.dtype == np.uint16 and pixels.shape[:2] == size:
                yield pixels

    def ground_truth(self) -> Trajectory | None:
        return None

    def _check_pictures(self, source: Path) -> None:
        first = first_picture(source, self._paths)
        if picture_size(first) == (self.camera.width, self.camera.height):
            return
        sample = np.unique(np.linspace(0, len(self) - 1, SIZE_SAMPLES).astype(int))
        if all(isinstance(self.read(int(i)), Unreadable) for i in sample):
            raise wrong_size(source, picture_size(first), self.camera)


def frame_of(picture: Picture, index: int, timestamps_ns: Array, camera: Camera, path: Path) -> Frame | Unreadable:
    """The frame of a decoded picture; unreadable where its size is not the calibrated one."""
    width, height = picture_size(picture)
    if (width, height) != (camera.width, camera.height):
        return Unreadable(path, f"it is {width}×{height} pixels, the calibration is for {camera.width}×{camera.height}")
    return Frame(index, int(timestamps_ns[index]), picture.grey, picture.color)


def picture_size(picture: Picture) -> tuple[int, int]:
    """Width and height."""
    return picture.grey.shape[1], picture.grey.shape[0]


def first_picture(source: Path, paths: tuple[Path, ...]) -> Picture:
    """The first readable picture; InputError where there is none."""
    reason = ""
    for path in paths:
        picture = read_picture(path)
        if isinstance(picture, Picture):
            return picture
        reason = reason or f"{picture.path}: {picture.reason}"
    raise InputError(f"{source}: none of its {len(paths)} pictures can be read ({reason}); check that the files are complete")


def check_count(source: Path, count: int) -> None:
    """InputError below two pictures."""
    if count == 0:
        raise InputError(f"{source}: no pictures; give a folder of pictures, a EuRoC, TUM or KITTI sequence, or a video")
    if count == 1:
        raise InputError(f"{source}: only one picture; a sequence needs at least two, taken while the camera moves")


def wrong_size(source: Path, size: tuple[int, int], camera: Camera) -> InputError:
    """The error for pictures that do not fit the calibration."""
    return InputError(
        f"{source}: the pictures are {size[0]}×{size[1]}, the calibration is for {camera.width}×{camera.height}; "
        "calibrate at the pictures' size, or scale the pictures or intrinsics to match"
    )
