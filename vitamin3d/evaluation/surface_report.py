# SPDX-License-Identifier: Apache-2.0
"""The surface of a run against the true one: its mesh and its cloud, by both protocols of `surface_error`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.datasets import Dataset
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.evaluation.comparison import Item, by_trajectory, place
from vitamin3d.evaluation.finished_run import Run, Truth
from vitamin3d.evaluation.reference_surface import cloud_of_depth, depth_maps, observed_by, reference_points
from vitamin3d.evaluation.run_evaluation import pair
from vitamin3d.evaluation.surface_error import surface_errors
from vitamin3d.scale import match_timestamps
from vitamin3d.types import Array, Trajectory

LEAST_KEYFRAMES = 0.5
"""Share of the keyframes that must have depth maps of their own, for these to be the reference."""


def surface_report(
    run: Run, own: list[Item], truth: Truth, dataset: Dataset, folder: Path, reference: Item | None
) -> dict[str, Any] | None:
    """All figures of the run's cloud and mesh; None where the sequence has no depth maps and no reference is given.

    Args:
        own: the run's cloud and mesh.
        truth: of the trajectory, in the reference's world, metres.
        folder: of the sequence, for its depth maps.
        reference: a scanner's cloud or a mesh.

    Raises:
        InputError: a file cannot be read.
    """
    of_camera = Trajectory(*_true_poses(run, truth))
    points = reference_points(reference.geometry) if reference is not None else cloud_of_depth(folder, dataset, of_camera)
    if points is None:
        return None
    observed, how = _observed(run, dataset, folder, points, of_camera, reference is None)
    report: dict[str, Any] = {
        "reference": {"origin": str(folder if reference is None else reference.path), "points": len(points)},
        "observed": {"points": len(observed), "how": how},
    }
    for item in own:
        placement = by_trajectory(item, truth, truth.trajectory)
        by_keyframes = place(item, placement, None)
        report[item.name.removeprefix("ours: ")] = {
            "all": asdict(surface_errors(place(item, placement, points).samples, points)),
            "observed_by_keyframes": asdict(surface_errors(by_keyframes.samples, observed)),
        }
    return report


def _true_poses(run: Run, truth: Truth) -> tuple[Array, Array]:
    """Times (T,) and poses (T, 4, 4) of the camera by the truth, at all of its moments."""
    finding = pair(run, truth).finding
    moved = finding.frame.value == "body" and truth.T_body_cam is not None
    poses = truth.trajectory.T_world_cam
    return truth.trajectory.timestamps_ns, poses @ truth.T_body_cam if moved else poses


def _observed(run: Run, dataset: Dataset, folder: Path, points: Array, truth: Trajectory, from_depth: bool) -> tuple[Array, str]:
    """The part of the reference that keyframes observed: their own depth maps, or what their cameras can see of it."""
    keyframes = read_tum(run.path / "keyframes.tum").timestamps_ns
    if from_depth:
        times = np.array([m.timestamp_ns for m in depth_maps(folder, dataset)], np.int64)
        near, _ = match_timestamps(keyframes, times, 1_000_000)
        own = cloud_of_depth(folder, dataset, truth, keyframes) if len(near) >= LEAST_KEYFRAMES * len(keyframes) else None
        if own is not None:
            return own, f"the depth maps of {len(near)} keyframes"
    _, rows = match_timestamps(keyframes, truth.timestamps_ns)
    seen = observed_by(points, truth.T_world_cam[rows], dataset.camera)
    return points[seen], f"seen by {len(rows)} keyframes: in their pictures and not hidden"


def surface_lines(report: dict[str, Any]) -> list[str]:
    """The figures for people."""
    seen = report["observed"]
    head = f"{'surface [cm]':31}{'median':>8}{'< 5 cm':>8}{'compl. 5/10 cm':>16}{'chamfer':>9}{'RMSE acc./compl./chamfer':>27}"
    lines = ["", f"surface  reference: {report['reference']['points']} points of {report['reference']['origin']}"]
    lines += [f"         observed by keyframes: {seen['points']} points, {seen['how']}", head]
    for kind in ("mesh", "cloud"):
        for name, label in (("all", "all, after ICP"), ("observed_by_keyframes", "observed, trajectories")):
            if kind in report:
                lines.append(f"{kind + ', ' + label:31}" + _figures(report[kind][name]))
    return lines


def _figures(e: dict[str, float]) -> str:
    rmse = " / ".join(f"{100 * e[key]:.2f}" for key in ("rmse_accuracy", "rmse_completion", "rmse_chamfer"))
    share = f"{e['completeness_5cm']:.3f} / {e['completeness_10cm']:.3f}"
    return f"{100 * e['accuracy_median']:>8.2f}{e['accuracy_within_5cm']:>8.3f}{share:>16}{100 * e['chamfer']:>9.2f}{rmse:>27}"
