# SPDX-License-Identifier: Apache-2.0
"""All figures of a run against its ground truth as one JSON object (Sec. 5.2 of the paper, and what the field adds)."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vitamin3d.datasets import Dataset
from vitamin3d.errors import InputError
from vitamin3d.evaluation.finished_run import Run, Truth
from vitamin3d.evaluation.reference_frame import (
    LEAST_SPREAD,
    FrameFinding,
    TruthFrame,
    can_be_aligned,
    check_quaternion_order,
    moved_into_camera,
    recognise_frame,
    spread,
)
from vitamin3d.evaluation.track_statistics import TrackStatistics, poses_at, track_statistics
from vitamin3d.evaluation.trajectory_error import (
    FITTED,
    Alignment,
    absolute_errors,
    aligned,
    alignment_between,
    matched,
    orientation_errors_deg,
    pairs_by_frames,
    pairs_by_time,
    pairs_by_travelled_distance,
    path_lengths,
    position_errors,
    relative_errors,
    running_rmse,
    success_rate,
    summarize,
)
from vitamin3d.scale import MATCH_TOLERANCE_NS, match_timestamps
from vitamin3d.timestamps import NANOSECONDS
from vitamin3d.types import Array, Trajectory

FRAME_DISTANCES = (1, 10)
TRAVELLED_DISTANCES = (0.1, 1.0, 10.0, 100.0)
"""In the truth's unit (metres); those longer than the path are left out."""
INTERVALS_S = (1, 5, 10, 30)
"""Seconds; those longer than the trajectory are left out."""
SAME_FRAME_NS = 1_000_000
LEAST_MATCHES = 3
FARTHEST_POSITION = 1e12


@dataclass(frozen=True)
class Pairing:
    """An estimate and a truth, both of the camera, paired by row."""

    estimate: Trajectory
    truth: Trajectory
    finding: FrameFinding


def evaluate(run: Run, truth: Truth | None, dataset: Dataset | None = None, offset_ns: int = 0) -> dict[str, Any]:
    """All figures; lengths in the truth's unit, taken for metres.

    Args:
        dataset: the sequence, for the number of frames of a bare trajectory, distances in frames, and tracks.
        offset_ns: added to the times of the estimate.

    Raises:
        InputError: the times do not overlap, the camera stands still, the quaternions are swapped, or T_BS is missing.
    """
    report = {"run": str(run.path), "source": _source(run, dataset), **_success(run, dataset)}
    paired = None
    if truth is not None:
        paired = pair(run, truth, offset_ns)
        report |= errors_of(paired, truth, dataset, offset_ns) | {"matched_share": len(paired.estimate) / len(run.estimate)}
    if run.tracks is not None and dataset is not None:
        poses = paired.truth if paired is not None else run.estimate
        statistics = asdict(tracks_of(run.tracks, dataset, poses))
        report["tracks"] = statistics | {"poses": "ground truth" if paired is not None else "the run's own"}
    return report


def _source(run: Run, dataset: Dataset | None) -> str:
    return dataset.name if dataset is not None else str(run.stats.get("source", "unknown"))


def _success(run: Run, dataset: Dataset | None) -> dict[str, Any]:
    stats, localised = run.stats, len(run.estimate)
    frames = int(stats["frames"]) if stats else None if dataset is None else len(dataset)
    if dataset is not None and not stats:
        localised = len(match_timestamps(dataset.timestamps_ns, run.estimate.timestamps_ns)[0])
    scale = stats.get("scale", {"known": False, "source": ""})
    figures = {"frames": frames, "localised": localised, "success_rate": None if frames is None else success_rate(localised, frames)}
    return figures | {"retries": stats.get("initialization_retries"), "is_metric": bool(scale["known"]), "scale_source": scale["source"]}


def pair(run: Run, truth: Truth, offset_ns: int = 0) -> Pairing:
    """The run's poses and the true ones of the same moments, both of one frame; InputError where that cannot be."""
    estimate = Trajectory(run.estimate.timestamps_ns + offset_ns, run.estimate.T_world_cam)
    a, b = matched(estimate, truth.trajectory)
    if len(a) < LEAST_MATCHES:
        raise _no_match(run, truth, estimate, len(a))
    _check_positions(a, str(run.trajectory_file), b, truth.origin)
    check_quaternion_order(a, b, truth.T_body_cam, (str(run.trajectory_file), truth.origin))
    finding = recognise_frame(a, b, truth.T_body_cam, truth.declared)
    if finding.frame is TruthFrame.BODY and truth.T_body_cam is not None:
        b = moved_into_camera(b, truth.T_body_cam)
    return Pairing(a, b, finding)


def _check_positions(estimate: Trajectory, estimate_name: str, truth: Trajectory, truth_name: str) -> None:
    """InputError where one of them has no size, or none that can be reckoned with, while the other moves."""
    both = ((estimate_name, estimate, truth), (truth_name, truth, estimate))
    for name, trajectory, _ in both:
        if np.abs(trajectory.T_world_cam[:, :3, 3]).max() > FARTHEST_POSITION:
            raise InputError(f"{name}: a position beyond {FARTHEST_POSITION:g} cannot be reckoned with; check the columns")
    for name, trajectory, other in both:
        if can_be_aligned(other, other) and spread(trajectory) <= LEAST_SPREAD:
            raise InputError(f"{name}: all positions are the same, so no scale can be found; a camera that moves is needed")


def _no_match(run: Run, truth: Truth, estimate: Trajectory, count: int) -> InputError:
    (a0, a1), (b0, b1) = ((t.timestamps_ns[[0, -1]] / NANOSECONDS).tolist() for t in (estimate, truth.trajectory))
    spans = f"{run.trajectory_file} covers {a0:.3f} to {a1:.3f} s, {truth.origin} {b0:.3f} to {b1:.3f} s"
    if a1 < b0 or b1 < a0:
        return InputError(f"no overlap in time: {spans}; give files of one sequence, or --time-offset {b0 - a0:.3f} if the clocks differ")
    return InputError(f"only {count} poses match within {MATCH_TOLERANCE_NS / 1e6:g} ms: {spans}; is the clock another? see --time-offset")


def errors_of(paired: Pairing, truth: Truth, dataset: Dataset | None, offset_ns: int = 0) -> dict[str, Any]:
    """Everything that compares the poses."""
    a, b, finding = paired.estimate, paired.truth, paired.finding
    is_fitted = can_be_aligned(a, b)
    best = Alignment.SIM3 if is_fitted else Alignment.NONE
    placed, path = aligned(a, b, best), float(path_lengths(b.T_world_cam[:, :3, 3])[-1])
    about = {
        "origin": truth.origin,
        "frame": finding.frame.value,
        "frame_is_certain": finding.is_certain,
        "frame_remark": finding.remark,
        "uncorrected_rmse": finding.uncorrected_rmse,
        "uncorrected_rotation_deg": finding.uncorrected_deg,
        "matched": len(a),
        "tolerance_ms": MATCH_TOLERANCE_NS / 1e6,
        "time_offset_s": offset_ns / NANOSECONDS,
        "path": path,
    }
    return {
        "truth": about,
        "alignment": best.value,
        "scale": alignment_between(a, b, best)[0] if is_fitted else None,
        "ate": {kind.value: asdict(summarize(absolute_errors(a, b, kind))) for kind in (FITTED if is_fitted else (best,))},
        "rotation_deg": asdict(summarize(orientation_errors_deg(placed, b))),
        "axes": {name: asdict(summarize(np.abs(column))) for name, column in zip("xyz", position_errors(placed, b).T, strict=True)},
        "rpe": _relative(placed, b, frame_steps(a, dataset), path),
        "chronological": chronology(placed, b),
    }


def chronology(placed: Trajectory, truth: Trajectory) -> dict[str, list[float]]:
    """The errors in time: seconds since the first pose, distance, its running RMSE, per axis, and angle."""
    differences = position_errors(placed, truth)
    distances = np.linalg.norm(differences, axis=1)
    columns = {
        "seconds": (truth.timestamps_ns - truth.timestamps_ns[0]) / NANOSECONDS,
        "error": distances,
        "running_rmse": running_rmse(distances),
        **dict(zip(("x", "y", "z"), differences.T, strict=True)),
        "rotation_deg": orientation_errors_deg(placed, truth),
    }
    return {name: np.round(column, 9).tolist() for name, column in columns.items()}


def _relative(placed: Trajectory, truth: Trajectory, steps: Array, path: float) -> dict[str, Any]:
    """RPE after the alignment by the name of the distance."""
    positions, times = truth.T_world_cam[:, :3, 3], truth.timestamps_ns
    duration = (times[-1] - times[0]) / NANOSECONDS
    pairs = {f"{n} frame{'s' * (n > 1)}": pairs_by_frames(steps, n) for n in FRAME_DISTANCES}
    pairs |= {f"{d:g} m travelled": pairs_by_travelled_distance(positions, d) for d in TRAVELLED_DISTANCES if d < path}
    pairs |= {f"{s} s": pairs_by_time(times, s * NANOSECONDS) for s in INTERVALS_S if s < duration}
    errors = {name: relative_errors(placed, truth, chosen) for name, chosen in pairs.items() if len(chosen)}
    return {name: {"translation": asdict(summarize(t)), "rotation_deg": asdict(summarize(r))} for name, (t, r) in errors.items()}


def frame_steps(trajectory: Trajectory, dataset: Dataset | None) -> Array:
    """Which of the frames that the run was given each pose (T,) is of: strides are divided out.

    Where the sequence is not known, or has not all of the poses, the shortest usual interval is taken for one frame.
    """
    _, nearest = match_timestamps(trajectory.timestamps_ns, dataset.timestamps_ns) if dataset is not None else (None, np.zeros(0, np.int64))
    if len(np.unique(nearest)) == len(trajectory):
        stride = int(np.gcd.reduce(np.diff(nearest))) if len(nearest) > 1 else 1
        return np.asarray((nearest - nearest[0]) // max(1, stride))
    gaps = np.diff(trajectory.timestamps_ns)
    frame = float(np.median(gaps[gaps < 1.5 * np.percentile(gaps, 10)])) if len(gaps) else 1.0
    return np.concatenate([[0], np.cumsum(np.maximum(1, np.rint(gaps / frame)))]).astype(np.int64)


def tracks_of(tracks: tuple[Array, Array, Array], dataset: Dataset, poses: Trajectory) -> TrackStatistics:
    """Statistics of the tracks, the epipolar geometry from these poses (of the camera)."""
    frame_index, track_id, pixels = tracks
    recorded = np.unique(frame_index)
    if len(recorded) and recorded[-1] >= len(dataset):
        raise InputError(f"{dataset.name} has {len(dataset)} frames, the tracks are of frame {recorded[-1]}; give the sequence of this run")
    T_world_cam = poses_at(dataset.timestamps_ns[recorded], poses, SAME_FRAME_NS)
    return track_statistics(frame_index, track_id, pixels, T_world_cam, dataset.camera)
