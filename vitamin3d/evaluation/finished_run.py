# SPDX-License-Identifier: Apache-2.0
"""What is evaluated: a finished run or a bare trajectory, the ground truth, and the sequence that both are of."""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.datasets import Dataset, open_dataset
from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.euroc import camera_folder
from vitamin3d.datasets.tables import read_text
from vitamin3d.datasets.trajectory_files import read_trajectory
from vitamin3d.errors import InputError
from vitamin3d.evaluation.reference_frame import TruthFrame
from vitamin3d.types import Array, Trajectory

STATES = Path("state_groundtruth_estimate0") / "data.csv"


@dataclass(frozen=True)
class Run:
    """What a finished run left behind, or what is known of a bare trajectory."""

    path: Path
    estimate: Trajectory
    stats: dict[str, Any]
    """`stats.json`; empty for a bare trajectory."""
    tracks: tuple[Array, Array, Array] | None = None
    """frame_index (N,), track_id (N,), pixel (N, 2)."""

    @property
    def trajectory_file(self) -> Path:
        return self.path / "trajectory.tum" if self.path.is_dir() else self.path


@dataclass(frozen=True)
class Truth:
    """A ground truth as its file has it, and where it is from."""

    trajectory: Trajectory
    origin: str
    declared: TruthFrame | None = None
    """Of which frame it is by its format or by the user; None: the file does not say."""
    T_body_cam: Array | None = None
    """(4, 4) of the calibration."""


def read_run(path: Path, kind: str | None = None, times: Path | None = None) -> Run:
    """A run's folder, or a trajectory file of any system; InputError where it is neither."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give the folder of a finished run or a trajectory")
    if path.is_file():
        return Run(path, read_trajectory(path, kind, times).trajectory, {})
    stats, tracks = _read_stats(path / "stats.json"), path / "tracks.npz"
    trajectory = read_trajectory(path / "trajectory.tum").trajectory
    return Run(path, trajectory, stats, _read_tracks(tracks) if tracks.is_file() else None)


def _read_stats(path: Path) -> dict[str, Any]:
    try:
        stats: dict[str, Any] = json.loads(read_text(path))
        missing = {"frames", "initialization_retries", "scale"} - set(stats)
    except (ValueError, TypeError):
        missing = {"a JSON object"}
    if missing:
        raise InputError(f"{path}: no {', '.join(sorted(missing))}; give the folder of a finished run")
    return stats


def _read_tracks(path: Path) -> tuple[Array, Array, Array]:
    try:
        with np.load(path) as arrays:
            return arrays["frame_index"], arrays["track_id"], arrays["pixel"].astype(np.float64)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        raise InputError(f"{path}: not the tracks of a run; run `vitamin3d reconstruct --save-tracks` again") from None


def read_sequence(ground_truth: Path | None, source: Path | None, calibration: Path | None) -> Dataset | None:
    """The sequence that was reconstructed: the source, or the folder that was given for the ground truth."""
    folder = source or (ground_truth if ground_truth is not None and ground_truth.is_dir() else None)
    return None if folder is None else open_dataset(folder, calibration)


@dataclass(frozen=True)
class TruthRequest:
    """Where a ground truth is, as the user says it."""

    path: Path | None
    """A file, a sequence's folder, or None: the source's own."""
    source: Path | None = None
    calibration: Path | None = None
    kind: str | None = None
    times: Path | None = None
    frame: TruthFrame | None = None


def read_truth(request: TruthRequest, dataset: Dataset | None) -> Truth | None:
    """The ground truth of a file or of a sequence; None where the sequence has none and no file is given.

    Raises:
        InputError: a file or folder was named and holds no ground truth.
    """
    folder = request.source or (request.path if request.path is not None and request.path.is_dir() else None)
    T_body_cam = extrinsics(folder, request.calibration)
    if request.path is not None and not request.path.is_dir():
        if not request.path.exists():
            raise InputError(f"{request.path}: no such file or folder; give a trajectory or a sequence with a ground truth")
        file = read_trajectory(request.path, request.kind, request.times)
        declared = request.frame or (TruthFrame.BODY if file.is_of_body else None)
        return Truth(file.trajectory, str(request.path), declared, T_body_cam)
    truth = None if folder is None else _truth_of_folder(folder, dataset, T_body_cam, request.frame)
    if truth is None and request.path is not None:
        raise InputError(f"{request.path}: this sequence has no ground truth; give a file with one")
    return truth


def _truth_of_folder(folder: Path, dataset: Dataset | None, T_body_cam: Array | None, frame: TruthFrame | None) -> Truth | None:
    camera = camera_folder(folder)
    states = None if camera is None else camera.resolve().parent / STATES
    if states is not None and states.is_file():
        return Truth(read_trajectory(states, "euroc").trajectory, str(states), frame or TruthFrame.BODY, T_body_cam)
    own = None if dataset is None else dataset.ground_truth()
    return None if own is None else Truth(own, f"{folder}", frame, T_body_cam)


def extrinsics(source: Path | None, calibration: Path | None) -> Array | None:
    """T_BS (4, 4) of a calibration file or of a EuRoC folder's `sensor.yaml`; None where nobody says."""
    camera = camera_folder(source) if source is not None and source.is_dir() else None
    for path in (calibration, camera / "sensor.yaml" if camera is not None else None):
        T_body_cam = read_calibration(path).T_body_cam if path is not None and path.is_file() else None
        if T_body_cam is not None:
            return T_body_cam
    return None
