# SPDX-License-Identifier: Apache-2.0
"""Sources of pictures. `open_dataset` recognises what it is given; `DATASETS` is where a new kind is added."""

from importlib import import_module
from pathlib import Path
from typing import cast

from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.euroc import camera_folder
from vitamin3d.datasets.pictures import PICTURE_SUFFIXES, Unreadable
from vitamin3d.datasets.video import VIDEO_SUFFIXES
from vitamin3d.errors import InputError

__all__ = ["DATASETS", "Dataset", "Unreadable", "kind_of", "open_dataset"]

DATASETS = {
    "euroc": "vitamin3d.datasets.euroc:EurocDataset",
    "tum": "vitamin3d.datasets.tum:TumDataset",
    "kitti": "vitamin3d.datasets.kitti:KittiDataset",
    "7scenes": "vitamin3d.datasets.seven_scenes:SevenScenesDataset",
    "icl": "vitamin3d.datasets.icl_nuim:IclNuimDataset",
    "images": "vitamin3d.datasets.image_folder:ImageFolderDataset",
    "video": "vitamin3d.datasets.video:VideoDataset",
}
"""Kind -> `module:Class`, imported on use; the class is called with (source, calibration)."""


def open_dataset(source: Path, calibration: Path | None = None) -> Dataset:
    """Opens a sequence.

    Args:
        source: a EuRoC, TUM, KITTI, 7-Scenes or ICL-NUIM folder, a folder of pictures, or a video.
        calibration: a file with the fields of EuRoC's `sensor.yaml`; overrides the source's own.

    Raises:
        InputError: one line that names the file and the remedy.
    """
    module, name = DATASETS[kind_of(source)].split(":")
    return cast(Dataset, getattr(import_module(module), name)(source, calibration))


def kind_of(source: Path) -> str:
    """The key in `DATASETS` of a source; InputError where it is none."""
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; check the path")
    return _kind_of_folder(source) if source.is_dir() else _kind_of_file(source)


def _kind_of_folder(source: Path) -> str:
    if camera_folder(source) is not None:
        return "euroc"
    if (source / "rgb.txt").is_file():
        return "tum"
    if (source / "times.txt").is_file() and any((source / name).is_dir() for name in ("image_0", "image_2")):
        return "kitti"
    if next(source.glob("frame-*.color.*"), None) is not None:
        return "7scenes"
    if (source / "associations.txt").is_file() and (source / "rgb").is_dir():
        return "icl"
    return "images"


def _kind_of_file(source: Path) -> str:
    suffix = source.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return "video"
    if suffix in PICTURE_SUFFIXES:
        raise InputError(f"{source}: a single picture; give the folder that holds the sequence")
    raise InputError(f"{source}: not a video ({', '.join(sorted(VIDEO_SUFFIXES))}); give a video or the folder of a sequence")
