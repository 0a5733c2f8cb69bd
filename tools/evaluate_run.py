# SPDX-License-Identifier: Apache-2.0
"""Scores a finished run: success rate, ATE and RPE against the ground truth, and how its tracks lived.

    python tools/evaluate_run.py OUT SOURCE
    python tools/evaluate_run.py OUT SOURCE --ground-truth truth.tum --json

OUT holds trajectory.tum and stats.json, and tracks.npz after `vitamin3d reconstruct --save-tracks`. All trajectories are of
the CAMERA: a ground truth in EuRoC's table (.csv), which is of the body, is moved into the camera by the source's T_BS; any
other file is read as TUM lines of the camera. Without --ground-truth the source's own is taken, where it has one.
"""

import argparse
import json
import sys
import zipfile
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.datasets import Dataset, open_dataset
from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.euroc import camera_folder
from vitamin3d.datasets.tables import read_text
from vitamin3d.datasets.trajectories import read_euroc_states, read_tum
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.evaluation.track_statistics import TrackStatistics, poses_at, track_statistics
from vitamin3d.evaluation.trajectory_error import (
    Alignment,
    ErrorSummary,
    absolute_errors,
    aligned,
    alignment_between,
    matched,
    pairs_by_frames,
    pairs_by_travelled_distance,
    path_lengths,
    relative_errors,
    success_rate,
    summarize,
)
from vitamin3d.scale import MATCH_TOLERANCE_NS, match_timestamps
from vitamin3d.types import Array, Trajectory

FRAME_DISTANCES = (1, 10)
TRAVELLED_DISTANCES = (0.1, 1.0, 10.0, 100.0)
"""In the truth's unit (metres); those longer than the path are left out."""
SAME_FRAME_NS = 1_000_000


@dataclass(frozen=True)
class Run:
    """What a finished run left behind."""

    estimate: Trajectory
    stats: dict[str, Any]
    tracks: tuple[Array, Array, Array] | None
    """frame_index (N,), track_id (N,), pixel (N, 2)."""


@dataclass(frozen=True)
class Truth:
    """A ground truth of the camera, and where it is from."""

    trajectory: Trajectory
    origin: str


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of a finished run")
    parser.add_argument("source", type=Path, help="the sequence that it is of")
    parser.add_argument("--calibration", type=Path, help="of the source, where it brings none")
    parser.add_argument("--ground-truth", type=Path, metavar="FILE", help="TUM lines of the camera, or EuRoC's table of the body (.csv)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Reads the run and the truth, prints; 2 with one line for bad input."""
    arguments = parsed(argv)
    try:
        report = evaluation(arguments)
    except Vitamin3dError as error:
        print(f"evaluate_run: {error}", file=sys.stderr)
        return 2
    print(json.dumps(without_nan(report)) if arguments.json else table(report))
    return 0


def evaluation(arguments: argparse.Namespace) -> dict[str, Any]:
    """All figures as a JSON object; lengths in the truth's unit."""
    run, dataset = read_run(arguments.out), open_dataset(arguments.source, arguments.calibration)
    truth = read_truth(arguments.ground_truth, arguments.source, dataset)
    report = {"run": str(arguments.out), "source": dataset.name, **_success(run)}
    if truth is not None:
        report |= _errors(run.estimate, truth, dataset)
    if run.tracks is not None:
        poses = truth.trajectory if truth is not None else run.estimate
        report["tracks"] = asdict(tracks_of(run.tracks, dataset, poses)) | {
            "poses": "ground truth" if truth is not None else "the run's own"
        }
    return report


def _success(run: Run) -> dict[str, Any]:
    frames, localised, scale = int(run.stats["frames"]), len(run.estimate), run.stats["scale"]
    figures = {"frames": frames, "localised": localised, "success_rate": success_rate(localised, frames)}
    return figures | {"retries": run.stats["initialization_retries"], "is_metric": bool(scale["known"]), "scale_source": scale["source"]}


def _errors(estimate: Trajectory, truth: Truth, dataset: Dataset) -> dict[str, Any]:
    a, b = matched(estimate, truth.trajectory)
    scale = alignment_between(a, b, Alignment.SIM3)[0]
    path = float(path_lengths(b.T_world_cam[:, :3, 3])[-1])
    ate = {alignment.value: asdict(summarize(absolute_errors(a, b, alignment))) for alignment in Alignment}
    about = {"origin": truth.origin, "frame": "camera", "matched": len(a), "tolerance_ms": MATCH_TOLERANCE_NS / 1e6, "path": path}
    return {"truth": about, "scale": scale, "ate": ate, "rpe": _relative(a, b, frame_steps(a, dataset), path)}


def _relative(estimate: Trajectory, truth: Trajectory, steps: Array, path: float) -> dict[str, Any]:
    """RPE after Sim(3) by the name of the distance."""
    placed, positions = aligned(estimate, truth, Alignment.SIM3), truth.T_world_cam[:, :3, 3]
    pairs = {f"{n} frame{'s' * (n > 1)}": pairs_by_frames(steps, n) for n in FRAME_DISTANCES}
    pairs |= {f"{d:g} m travelled": pairs_by_travelled_distance(positions, d) for d in TRAVELLED_DISTANCES if d < path}
    errors = {name: relative_errors(placed, truth, chosen) for name, chosen in pairs.items() if len(chosen)}
    return {name: {"translation": asdict(summarize(t)), "rotation_deg": asdict(summarize(r))} for name, (t, r) in errors.items()}


def frame_steps(trajectory: Trajectory, dataset: Dataset) -> Array:
    """Which of the frames that the run was given each pose (T,) is of: strides are divided out."""
    _, nearest = match_timestamps(trajectory.timestamps_ns, dataset.timestamps_ns)
    if len(np.unique(nearest)) < len(trajectory):
        raise InputError(f"{dataset.name}: its pictures were taken at other times than the run's; give the sequence of this run")
    stride = int(np.gcd.reduce(np.diff(nearest))) if len(nearest) > 1 else 1
    return np.asarray((nearest - nearest[0]) // max(1, stride))


def tracks_of(tracks: tuple[Array, Array, Array], dataset: Dataset, poses: Trajectory) -> TrackStatistics:
    """Statistics of the tracks, the epipolar geometry from these poses (of the camera)."""
    frame_index, track_id, pixels = tracks
    recorded = np.unique(frame_index)
    if len(recorded) and recorded[-1] >= len(dataset):
        raise InputError(f"{dataset.name} has {len(dataset)} frames, the tracks are of frame {recorded[-1]}; give the sequence of this run")
    T_world_cam = poses_at(dataset.timestamps_ns[recorded], poses, SAME_FRAME_NS)
    return track_statistics(frame_index, track_id, pixels, T_world_cam, dataset.camera)


# --- reading ---------------------------------------------------------------------------------------------------------


def read_run(out: Path) -> Run:
    """InputError where the run has no trajectory or no statistics."""
    stats, tracks = _read_stats(out / "stats.json"), out / "tracks.npz"
    return Run(read_tum(out / "trajectory.tum"), stats, _read_tracks(tracks) if tracks.is_file() else None)


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


def read_truth(path: Path | None, source: Path, dataset: Dataset) -> Truth | None:
    """The ground truth of the camera from a file or from the source; None where neither is there."""
    if path is None:
        own = dataset.ground_truth()
        return None if own is None else Truth(own, f"{dataset.name}'s own")
    if path.suffix.lower() == ".csv":
        return Truth(read_euroc_states(path, _body_from_camera(source)), f"{path}, moved from the body into the camera by T_BS")
    return Truth(read_tum(path), str(path))


def _body_from_camera(source: Path) -> Array:
    folder = camera_folder(source)
    T_body_cam = read_calibration(folder / "sensor.yaml").T_body_cam if folder is not None else None
    if T_body_cam is None:
        raise InputError(f"{source}: no `T_BS`, so a ground truth of the body cannot be moved into the camera; give one of the camera")
    return T_body_cam


# --- printing --------------------------------------------------------------------------------------------------------


def without_nan(value: Any) -> Any:
    """The same with None for every NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def table(report: dict[str, Any]) -> str:
    """The report for people."""
    lines = [
        f"run      {report['run']}, of {report['source']}",
        f"frames   {report['localised']} of {report['frames']} localised: success rate {100 * report['success_rate']:.1f} %",
        f"map      initialised after {report['retries']} retries, {_scale(report)}",
    ]
    lines += _error_lines(report) if "truth" in report else ["truth    none: no ATE, no RPE"]
    return "\n".join(lines + (_track_lines(report["tracks"]) if "tracks" in report else ["tracks   none: run with --save-tracks"]))


def _scale(report: dict[str, Any]) -> str:
    return f"metric ({report['scale_source']})" if report["is_metric"] else "up to scale: its SE(3) row compares map units with the truth's"


def _error_lines(report: dict[str, Any]) -> list[str]:
    about = report["truth"]
    lines = [
        f"truth    of the {about['frame']} ({about['origin']}), {about['path']:.2f} m long; {about['matched']} poses match within "
        f"{about['tolerance_ms']:g} ms; its unit is taken for metres",
        "",
        f"{'ATE of the camera centres [cm]':32}{'RMSE':>10}{'median':>10}{'max':>10}",
    ]
    for name, errors in report["ate"].items():
        remark = f" (scale {report['scale']:.6g})" if name == Alignment.SIM3.value else ""
        lines.append(f"{'after ' + name + remark:32}{_cells(ErrorSummary(**errors), 100)}")
    lines += ["", f"{'RPE after Sim(3)':32}{'RMSE':>10}{'median':>10}{'max':>10}{'pairs':>10}"]
    for name, kinds in report["rpe"].items():
        lines += [_relative_line(f"{name}, translation [cm]", kinds["translation"], 100)]
        lines += [_relative_line(f"{name}, rotation [deg]", kinds["rotation_deg"], 1)]
    return lines


def _relative_line(name: str, errors: dict[str, Any], factor: float) -> str:
    return f"{name:32}{_cells(ErrorSummary(**errors), factor)}{errors['count']:>10}"


def _cells(errors: ErrorSummary, factor: float) -> str:
    return "".join(f"{factor * value:>10.4f}" for value in (errors.rmse, errors.median, errors.maximum))


def _track_lines(tracks: dict[str, Any]) -> list[str]:
    lines = [
        "",
        f"tracks   {tracks['num_tracks']}; live per frame: median {tracks['live_median']:.0f}, minimum {tracks['live_minimum']}; "
        f"length: median {tracks['length_median']:.0f}, p90 {tracks['length_p90']:.0f} frames",
        f"{'age [frames]':32}{'survival':>10}{'epipolar inliers (Sampson < 1 px, poses: ' + tracks['poses'] + ')':>60}",
    ]
    return lines + [f"{a['age']:<32}{a['survival']:>10.3f}{a['epipolar_inlier_ratio']:>60.3f}" for a in tracks["ages"]]


if __name__ == "__main__":
    sys.exit(main())
