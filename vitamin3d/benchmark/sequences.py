# SPDX-License-Identifier: Apache-2.0
"""Finds the sequences of a benchmark below a folder."""

from pathlib import Path

from vitamin3d.datasets import kind_of
from vitamin3d.datasets.image_folder import natural_key
from vitamin3d.errors import InputError

KINDS = ("euroc", "tum", "icl", "7scenes", "kitti")
LAYOUTS = {
    "euroc": "mav0/cam0/data.csv",
    "tum": "rgb.txt",
    "icl": "associations.txt and rgb/",
    "7scenes": "frame-*.color.png",
    "kitti": "times.txt and image_0/",
}
DEPTH = 4
"""Levels below the root that are searched."""


def sequences_of(kind: str, root: Path) -> list[Path]:
    """All sequences of a kind at or below a folder, in natural order of their names.

    Raises:
        InputError: there is none, or no folder.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; give the folder that holds the sequences")
    found = _below(kind, root, DEPTH)
    if not found:
        raise InputError(f"{root}: no {kind} sequence at or below it (one has {LAYOUTS[kind]}); give the folder that holds the sequences")
    return sorted(found, key=lambda path: natural_key(str(path)))


def _below(kind: str, folder: Path, levels: int) -> list[Path]:
    if _is_sequence(kind, folder):
        return [folder]
    if levels == 0:
        return []
    try:
        children = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    except OSError:
        return []
    return [found for child in children for found in _below(kind, child, levels - 1)]


def _is_sequence(kind: str, folder: Path) -> bool:
    return folder.name not in ("mav0", "cam0", "cam1") and kind_of(folder) == kind


def names_of(sequences: list[Path]) -> list[str]:
    """A short name for each: as many of the last parts of the path as make it unlike the others."""
    paths = [path.absolute() for path in sequences]
    for depth in range(1, DEPTH + 2):
        names = ["_".join(path.parts[-depth:]) for path in paths]
        if len(set(names)) == len(names):
            break
    return names
