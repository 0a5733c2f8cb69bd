# SPDX-License-Identifier: Apache-2.0
"""Measures what each ingredient of the tracker and the map is worth: the default, and each ingredient off, one at a time.

    python tools/ablation.py SOURCE --output ablation.md
    python tools/ablation.py SOURCE --seeds 1 --only default --only coasting --score-tracks

Runs the sparse half alone, one frame after the other, once per seed, and writes a Markdown table. SOURCE needs a ground
truth. ATE is the RMSE of the camera centres after Sim(3) over the frames localised; the truth is of the camera.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.atlas import Atlas
from vitamin3d.config import Config, paper_config
from vitamin3d.datasets import Dataset, open_dataset
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.evaluation.track_statistics import TrackStatistics, poses_at, track_statistics
from vitamin3d.evaluation.trajectory_error import Alignment, absolute_errors, matched, success_rate, summarize
from vitamin3d.exporters.files import write_file
from vitamin3d.run_statistics import largest_map, num_localised
from vitamin3d.runtime import RunRecord, median_of, run_sequential
from vitamin3d.scale import MATCH_TOLERANCE_NS
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Trajectory

INGREDIENTS: tuple[tuple[str, str, Any], ...] = (
    ("dense flow prediction", "extrema_tracking.prediction", "dominant_flow"),
    ("dense flow prediction", "extrema_tracking.gate_px", 8.0),
    ("coasting", "extrema_tracking.coast_frames", 0),
    ("weak extrema", "extrema.min_curvature", 0.3),
    ("weak extrema", "extrema.wanted", 0),
    ("round extrema", "extrema.min_roundness", 0.0),
    ("round extrema", "extrema_tracking.min_roundness", 0.0),
    ("smoothing", "curvature.smoothing_sigma_px", 0.0),
    ("gate", "extrema_tracking.gate_px", 8.0),
    ("reprojection gate that follows the frame", "localization.outlier_medians", 100.0),
    ("recovery", "recovery.enabled", False),
    ("relocalization", "relocalization.enabled", False),
    ("anchors", "window.anchors", 0),
    ("long windows", "window.keyframes", 8),
    ("choice of long tracks in windows", "bundle_adjustment.points_per_keyframe", 0),
    ("frames that are localised only", "bundle_adjustment.sweeps_per_frame", 2),
    ("Schur complement", "bundle_adjustment.keyframe_solver", "subspace"),
    ("motion prior before RANSAC", "localization.prior_inlier_ratio", 2.0),
    ("more than 2000 tracks", "extrema.max_tracks", 2000),
    ("refined calibration", "calibration.refine", "off"),
    ("rolling shutter", "calibration.readout", False),
    ("final adjustment", "final_adjustment.enabled", False),
)
"""Ingredient, setting, its value without the ingredient; lines of one name belong together. A new ingredient is a line."""
DEFAULT, PAPER = "default", "paper"
MIN_POSES = 3
WARM_UP_FRAMES = 60
SCORED_AGES = (10, 20)
COLUMNS = ("ATE [cm]", "frames localised", "live tracks", "keyframes", "landmarks", "ms per frame")
TRACK_COLUMNS = tuple(f"{what} {age}" for age in SCORED_AGES for what in ("survival", "inliers"))


@dataclass(frozen=True)
class Score:
    """One run in numbers; NaN where it has none."""

    ate_cm: float
    localised: float
    """Share of the frames."""
    live_tracks: float
    """Median over the frames."""
    keyframes: float
    landmarks: float
    milliseconds: float
    """CPU time per frame, pictures read and the final adjustment included."""
    tracks: tuple[float, ...] = ()
    """Survival and epipolar inlier ratio at each of SCORED_AGES."""


@dataclass(frozen=True)
class Trial:
    """The sequence that all settings run on."""

    dataset: Dataset
    truth: Trajectory
    indices: range
    score_tracks: bool


def variants() -> dict[str, Config]:
    """Settings by name: the default, each ingredient off, the paper."""
    found = {DEFAULT: Config()}
    for name, setting, value in INGREDIENTS:
        found[name] = with_setting(found.get(name, Config()), setting, value)
    return found | {PAPER: paper_config()}


def with_setting(config: Config, setting: str, value: Any) -> Config:
    """The settings with one replaced, by its dotted name; InputError where there is no such setting or type."""
    group, _, name = setting.partition(".")
    old = getattr(getattr(config, group, None), name, None)
    if type(old) is not type(value):
        raise InputError(f"{setting}: no setting that could be {value!r}; see `vitamin3d config`")
    changed = dataclasses.replace(getattr(config, group), **{name: value})
    return dataclasses.replace(config, **{group: changed})


def run(trial: Trial, config: Config) -> Score:
    """Tracks and maps the sequence once."""
    front_end, atlas = FrontEnd(config), Atlas(trial.dataset.camera, config)
    start = time.process_time()
    record = run_sequential(trial.dataset, trial.indices, front_end, atlas, record=RunRecord(tracks=[] if trial.score_tracks else None))
    atlas.finish()
    seconds, slam = time.process_time() - start, largest_map(atlas)
    return Score(
        ate_cm=100 * ate(slam.trajectory(), trial.truth),
        localised=success_rate(num_localised(atlas), len(trial.indices)),
        live_tracks=median_of(record.live_tracks),
        keyframes=slam.map.num_keyframes,
        landmarks=len(slam.map.landmarks),
        milliseconds=1e3 * seconds / len(trial.indices),
        tracks=track_scores(record, trial) if trial.score_tracks else (),
    )


def ate(estimate: Trajectory, truth: Trajectory) -> float:
    """RMSE of the camera centres after Sim(3), in the truth's unit; NaN for too few poses."""
    a, b = matched(estimate, truth)
    return summarize(absolute_errors(a, b, Alignment.SIM3)).rmse if len(a) >= MIN_POSES else float("nan")


def track_scores(record: RunRecord, trial: Trial) -> tuple[float, ...]:
    """Survival and epipolar inlier ratio (poses: the truth's) at the ages of the table."""
    kept = [row for row in record.tracks or [] if len(row[1])]
    if not kept:
        return (float("nan"),) * len(TRACK_COLUMNS)
    frames = np.concatenate([np.full(len(ids), index, np.int64) for index, ids, _ in kept])
    poses = poses_at(trial.dataset.timestamps_ns[np.unique(frames)], trial.truth, MATCH_TOLERANCE_NS)
    ids, pixels = np.concatenate([ids for _, ids, _ in kept]), np.concatenate([pixels for *_, pixels in kept])
    return _at_scored_ages(track_statistics(frames, ids, pixels, poses, trial.dataset.camera))


def _at_scored_ages(found: TrackStatistics) -> tuple[float, ...]:
    ages = {a.age: a for a in found.ages}
    return tuple(value for age in SCORED_AGES for value in (ages[age].survival, ages[age].epipolar_inlier_ratio))


# --- the table -------------------------------------------------------------------------------------------------------


def measured(trial: Trial, chosen: dict[str, Config], seeds: int, tell: Callable[[str], None]) -> dict[str, list[Score]]:
    """The scores of each variant, one per seed."""
    warm_up = dataclasses.replace(trial, indices=trial.indices[:WARM_UP_FRAMES])
    run(warm_up, next(iter(chosen.values())))
    scores: dict[str, list[Score]] = {}
    for name, config in chosen.items():
        for seed in range(seeds):
            score = run(trial, dataclasses.replace(config, seed=seed))
            scores.setdefault(name, []).append(score)
            tell(f"{name}, seed {seed}: ATE {score.ate_cm:.4g} cm, {100 * score.localised:.1f} % localised")
    return scores


def markdown(trial: Trial, scores: dict[str, list[Score]], how: str) -> str:
    """The page: what was run, by which command, and the table."""
    seeds = len(next(iter(scores.values())))
    columns = COLUMNS + (TRACK_COLUMNS if trial.score_tracks else ())
    lines = [
        f"# What each ingredient is worth: {trial.dataset.name}",
        "",
        f"{len(trial.indices)} frames, {seeds} seed{'s' * (seeds > 1)} each, sparse half alone (`{how}`).",
        "ATE: RMSE of the camera centres after Sim(3) over the frames localised; the truth is of the camera. Mean ± standard deviation",
        "over the seeds, means in the other columns. Time is CPU time, one thread, with the reading of pictures.",
        *([_about_tracks()] if trial.score_tracks else []),
        "",
        f"| | {' | '.join(columns)} |",
        f"|---|{'---|' * len(columns)}",
        *(f"| {label(name)} | {' | '.join(cells(runs))} |" for name, runs in scores.items()),
    ]
    return "\n".join(lines) + "\n"


def _about_tracks() -> str:
    return (
        "Survival: of the tracks of a frame, those still seen so many frames later, tracks that left the picture counted as lost; "
        "inliers: of these, with a Sampson distance below 1 px from the true epipolar geometry."
    )


def label(name: str) -> str:
    """How a variant is called in the table."""
    if name in (DEFAULT, PAPER):
        return "**default**" if name == DEFAULT else "the paper (`--mode paper`)"
    changes = [f"`{setting} = {value}`" for ingredient, setting, value in INGREDIENTS if ingredient == name]
    return f"without {name} ({', '.join(changes)})"


def cells(runs: Sequence[Score]) -> list[str]:
    """A row: the figures of a variant over its seeds."""
    failures = sum(bool(np.isnan(score.ate_cm)) for score in runs)
    lost = f" ({failures} of {len(runs)} without map)" if failures else ""
    whole = [f"{mean([getattr(score, name) for score in runs]):.0f}" for name in ("live_tracks", "keyframes", "landmarks")]
    tracks = [f"{mean(values):.3f}" for values in zip(*(score.tracks for score in runs), strict=True)]
    localised = f"{100 * mean([score.localised for score in runs]):.1f} %"
    return [spread([s.ate_cm for s in runs]) + lost, localised, *whole, f"{mean([s.milliseconds for s in runs]):.1f}", *tracks]


def mean(values: Sequence[float]) -> float:
    """Mean of those that are numbers; NaN for none."""
    found = np.array(values, np.float64)
    found = found[np.isfinite(found)]
    return float(found.mean()) if len(found) else float("nan")


def spread(values: Sequence[float]) -> str:
    """`mean ± standard deviation` of those that are numbers, the mean alone for one."""
    found = [value for value in values if np.isfinite(value)]
    if not found:
        return "–"
    return f"{np.mean(found):.3g}" + (f" ± {np.std(found, ddof=1):.2g}" if len(found) > 1 else "")


# --- the command -----------------------------------------------------------------------------------------------------


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="a sequence with ground truth")
    parser.add_argument("--calibration", type=Path, help="of the source, where it brings none")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="runs of each variant, seeds 0 to N - 1")
    parser.add_argument("--frames", type=int, metavar="N", help="the first N frames alone")
    parser.add_argument("--only", action="append", metavar="NAME", help=f"variants to run: {', '.join(variants())}")
    parser.add_argument("--score-tracks", action="store_true", help="survival and epipolar inliers of the tracks, too")
    parser.add_argument("--output", type=Path, help="Markdown file; default: standard output")
    return parser.parse_args(argv)


def prepared(arguments: argparse.Namespace) -> tuple[Trial, dict[str, Config]]:
    """The sequence and the variants that are asked for."""
    if arguments.seeds < 1 or (arguments.frames is not None and arguments.frames < 2):
        raise InputError("--seeds must be at least 1, --frames at least 2")
    if arguments.output is not None and not arguments.output.resolve().parent.is_dir():
        raise InputError(f"--output {arguments.output}: its folder does not exist; make it, or choose another")
    known = variants()
    unknown = [name for name in arguments.only or () if name not in known]
    if unknown:
        raise InputError(f"--only {unknown[0]}: choose from {', '.join(known)}")
    dataset = open_dataset(arguments.source, arguments.calibration)
    truth = dataset.ground_truth()
    if truth is None:
        raise InputError(f"{dataset.name}: no ground truth; give a sequence that has one")
    trial = Trial(dataset, truth, range(len(dataset))[: arguments.frames], arguments.score_tracks)
    return trial, {name: known[name] for name in arguments.only or known}


def command(arguments: argparse.Namespace) -> str:
    """The command line that makes the same table."""
    only = [f"--only '{name}'" for name in arguments.only or ()]
    frames = [f"--frames {arguments.frames}"] if arguments.frames is not None else []
    tracks = ["--score-tracks"] if arguments.score_tracks else []
    return " ".join(["tools/ablation.py", arguments.source.resolve().name, f"--seeds {arguments.seeds}", *frames, *only, *tracks])


def main(argv: list[str] | None = None) -> int:
    """Runs all variants and writes the table; 2 with one line for bad input."""
    arguments = parsed(argv)
    try:
        trial, chosen = prepared(arguments)
        scores = measured(trial, chosen, arguments.seeds, lambda line: print(line, file=sys.stderr, flush=True))
        page = markdown(trial, scores, command(arguments))
        if arguments.output is not None:
            write_file(arguments.output, [page.encode()])
    except Vitamin3dError as error:
        print(f"ablation: {error}", file=sys.stderr)
        return 2
    print(arguments.output if arguments.output is not None else page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
