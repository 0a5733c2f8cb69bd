# SPDX-License-Identifier: Apache-2.0
"""The figures of `run_evaluation` for people (a table), for programs (JSON) and for the eye (plots)."""

import json
from math import isfinite
from typing import Any

import numpy as np

from vitamin3d.evaluation.run_evaluation import Pairing
from vitamin3d.evaluation.surface_report import surface_lines
from vitamin3d.evaluation.trajectory_error import Alignment, ErrorSummary, aligned
from vitamin3d.exporters.line_plot import Axes, Line, line_plot

CM = 100.0


def without_nan(value: Any) -> Any:
    """The same with None for every NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def as_json(report: dict[str, Any]) -> str:
    """One JSON object with a line per figure; arrays stay on one line."""
    series = {key: report[key] for key in ("chronological",) if key in report}
    rest = json.dumps(without_nan({key: value for key, value in report.items() if key not in series}), indent=1)
    tail = "".join(f',\n "{key}": {json.dumps(without_nan(value))}' for key, value in series.items())
    return f"{rest[:-2]}{tail}\n}}\n"


def table(report: dict[str, Any]) -> str:
    """The report for people."""
    lines = [f"run      {report['run']}, of {report['source']}", _frames_line(report)]
    if report["retries"] is not None:
        lines += [f"map      initialised after {report['retries']} retries, {_scale(report)}"]
    lines += _error_lines(report) if "truth" in report else ["truth    none: no ATE, no RPE; give --ground-truth"]
    lines += surface_lines(report["surface"]) if "surface" in report else []
    return "\n".join(lines + (_track_lines(report["tracks"]) if "tracks" in report else []))


def _frames_line(report: dict[str, Any]) -> str:
    if report["frames"] is None:
        return f"frames   {report['localised']} localised; success rate unknown: give --source, or the sequence's folder as --ground-truth"
    return f"frames   {report['localised']} of {report['frames']} localised: success rate {100 * report['success_rate']:.1f} %"


def _scale(report: dict[str, Any]) -> str:
    return f"metric ({report['scale_source']})" if report["is_metric"] else "up to scale: its SE(3) row compares map units with the truth's"


def _error_lines(report: dict[str, Any]) -> list[str]:
    about, share = report["truth"], 100 * report.get("matched_share", 1.0)
    lines = [
        f"truth    {about['origin']}, {about['path']:.2f} m long; {about['matched']} poses "
        f"({share:.1f} % of the run's) match within {about['tolerance_ms']:g} ms; its unit is taken for metres",
        f"frame    camera: {about['frame_remark']}",
    ]
    if about["uncorrected_rmse"] is not None:
        off = f"{CM * about['uncorrected_rmse']:.4f} cm and {about['uncorrected_rotation_deg']:.1f} degrees"
        lines += [f"         taken as it is, without T_BS, it would be {off} off"]
    if report["alignment"] == Alignment.NONE.value:
        lines += ["align    none: the true camera hardly moved, so that nothing can be fitted; both are taken to be in one world"]
    lines += ["", f"{'ATE of the camera centres [cm]':36}{'RMSE':>10}{'median':>10}{'max':>10}"]
    for name, errors in report["ate"].items():
        remark = f" (scale {report['scale']:.6g})" if name == Alignment.SIM3.value else ""
        lines.append(f"{'after ' + name + remark:36}{_cells(ErrorSummary(**errors), CM)}")
    for name, errors in report["axes"].items():
        lines.append(f"{'  along ' + name:36}{_cells(ErrorSummary(**errors), CM)}")
    lines.append(f"{'orientation [deg]':36}{_cells(ErrorSummary(**report['rotation_deg']), 1)}")
    lines += ["", f"{'RPE after ' + report['alignment']:36}{'RMSE':>10}{'median':>10}{'max':>10}{'pairs':>10}"]
    for name, kinds in report["rpe"].items():
        lines += [_relative_line(f"{name}, translation [cm]", kinds["translation"], CM)]
        lines += [_relative_line(f"{name}, rotation [deg]", kinds["rotation_deg"], 1)]
    return lines


def _relative_line(name: str, errors: dict[str, Any], factor: float) -> str:
    return f"{name:36}{_cells(ErrorSummary(**errors), factor)}{errors['count']:>10}"


def _cells(errors: ErrorSummary, factor: float) -> str:
    return "".join(f"{factor * value:>10.4f}" for value in (errors.rmse, errors.median, errors.maximum))


def _track_lines(tracks: dict[str, Any]) -> list[str]:
    lines = [
        "",
        f"tracks   {tracks['num_tracks']}; live per frame: median {tracks['live_median']:.0f}, minimum {tracks['live_minimum']}; "
        f"length: median {tracks['length_median']:.0f}, p90 {tracks['length_p90']:.0f} frames",
        f"{'age [frames]':36}{'survival':>10}{'epipolar inliers (Sampson < 1 px, poses: ' + tracks['poses'] + ')':>58}",
    ]
    return lines + [f"{a['age']:<36}{a['survival']:>10.3f}{a['epipolar_inlier_ratio']:>58.3f}" for a in tracks["ages"]]


def plots(report: dict[str, Any], paired: Pairing) -> dict[str, str]:
    """File stem -> SVG: both trajectories from the three sides with most to see, and the errors in time."""
    series = {name: np.array(values) for name, values in report["chronological"].items()}
    seconds, placed = series["seconds"], aligned(paired.estimate, paired.truth, Alignment(report["alignment"]))
    a, b = placed.T_world_cam[:, :3, 3], paired.truth.T_world_cam[:, :3, 3]
    u, v = np.sort(np.argsort(np.ptp(b, axis=0))[1:])
    error = [Line("distance", seconds, CM * series["error"]), Line("RMSE so far", seconds, CM * series["running_rmse"], is_dashed=True)]
    axes = [Line(name, seconds, CM * series[name]) for name in ("x", "y", "z")]
    return {
        "error_over_time": line_plot(Axes(f"Position error after {report['alignment']}", "time [s]", "error [cm]", from_zero=True), error),
        "error_per_axis": line_plot(Axes("Position error along the truth's axes", "time [s]", "estimate less truth [cm]"), axes),
        "rotation_over_time": line_plot(
            Axes("Orientation error", "time [s]", "angle [deg]", from_zero=True), [Line("angle", seconds, series["rotation_deg"])]
        ),
        "trajectory": line_plot(
            Axes("Trajectory", f"{'xyz'[u]} [m]", f"{'xyz'[v]} [m]", 640, 480, is_equal=True),
            [Line("ground truth", b[:, u], b[:, v], "#57606a", is_dashed=True), Line("estimate", a[:, u], a[:, v], "#1f6feb")],
        ),
    }
