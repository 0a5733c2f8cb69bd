# SPDX-License-Identifier: Apache-2.0
"""Any folder of pictures, with a calibration file."""

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from vitamin3d.datasets.base import Listing, PictureSequence
from vitamin3d.datasets.calibration import DEFAULT_RATE_HZ, Calibration, missing_calibration, read_calibration
from vitamin3d.datasets.pictures import PICTURE_SUFFIXES
from vitamin3d.datasets.tables import nanoseconds_from_seconds, regular_timestamps
from vitamin3d.errors import InputError

DIGITS = "0123456789"
NANOSECOND_STEM = re.compile(r"[0-9]{16,18}|[0-8][0-9]{18}")
SECOND_STEM = re.compile(r"[0-9]{1,9}\.[0-9]+|[0-8][0-9]{9}\.[0-9]+")


def pictures_in(folder: Path) -> list[Path]:
    """The picture files of a folder in natural order (`2.png` before `10.png`)."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror}); check the path and its permissions") from None
    return sorted(files, key=lambda path: natural_key(path.name))


def natural_key(name: str) -> tuple[list[tuple[bool, int, str]], str]:
    """Sorting key that compares the runs of digits in a name as numbers."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(part[0] not in DIGITS, int(part) if part[0] in DIGITS else 0, part.lower()) for part in parts], name


class ImageFolderDataset(PictureSequence):
    """A folder of pictures; times come from the names where all are times, else from the rate."""

    def __init__(self, source: Path, calibration: Path | None = None) -> None:
        path = calibration or source / "camera.yaml"
        if calibration is None and not path.is_file():
            raise missing_calibration(source)
        loaded = read_calibration(path)
        super().__init__(source, loaded.camera, _listing(source, loaded))


def _listing(source: Path, calibration: Calibration) -> Listing:
    paths = pictures_in(source)
    for pattern, nanoseconds in ((NANOSECOND_STEM, int), (SECOND_STEM, nanoseconds_from_seconds)):
        if paths and all(pattern.fullmatch(path.stem) for path in paths):
            return _listing_by_name(paths, nanoseconds)
    return Listing(regular_timestamps(len(paths), calibration.rate_hz or DEFAULT_RATE_HZ), paths)


def _listing_by_name(paths: list[Path], nanoseconds: Callable[[str], int]) -> Listing:
    pairs = sorted((nanoseconds(path.stem), path) for path in paths)
    for (before, first), (after, second) in pairwise(pairs):
        if before == after:
            raise InputError(f"{second}: the same time as {first.name}; remove one of the two")
    return Listing([time for time, _ in pairs], [path for _, path in pairs])
