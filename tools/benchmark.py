# SPDX-License-Identifier: Apache-2.0
"""Measures a run step by step beside the paper's Tables 2 and 3, OpenCV's KLT and a Schur solver, in one process.

    python tools/benchmark.py SEQUENCE                           # default settings; CPU milliseconds: median and 95th percentile
    python tools/benchmark.py SEQUENCE --live --json new.json --against old.json
    python tools/benchmark.py SEQUENCE --loop 20000 --dense      # back and forth: does memory level off?

The steps run one after the other on one thread and are timed by that thread's CPU, so that other load on the machine
matters little; the processor's caches it still shares. The sparse half runs first (its scale from the ground truth, where
there is one: the paper's voxels are 15 and 2.5 cm), then the dense half over its keyframes. In every frame KLT tracks as
many points as are alive, forward only; of every fifth window the window is also solved by the Schur complement alone. The
volumes' time is that of fusing one view and extracting the whole surface: the median over ten times in the course of the run,
and the last time, "at the end".
"""

import argparse
import dataclasses
import itertools
import json
import os
import platform
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmark_tracking import DEMO, klt_milliseconds

from vitamin3d.benchmark.published import TABLE_2_MS, TABLE_3_MS
from vitamin3d.benchmark.tables import PARTS
from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.bundle_adjustment.marginalization import CameraPrior
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.commands.process import keep_freed_memory
from vitamin3d.config import BundleAdjustmentConfig, Config, live_config, load_toml, paper_config
from vitamin3d.datasets import Dataset, Unreadable, open_dataset
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.exporters.files import write_file
from vitamin3d.exporters.line_plot import Axes, Line, line_plot
from vitamin3d.geometry.cameras import Camera
from vitamin3d.map_output import with_voxels
from vitamin3d.mapping.landmark_statistics import information_by_row
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.run_statistics import step_table, versions
from vitamin3d.scale import Scale, scale_from_ground_truth
from vitamin3d.slam import Slam
from vitamin3d.slam_steps import SlamSteps
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import BundleReport, Frame, StepTimes
from vitamin3d.warmup import warm_up

SCHUR_INTERVAL = 5
MEMORY_INTERVAL = 250
EXTRACTIONS = 10
"""The surfaces are extracted so often in the course of a run."""
KLT, SCHUR, DECODING = "OpenCV KLT, as many points", "Schur complement, same window", "decoding"


Telling = Callable[[int, Slam, list[tuple[int, Frame]]], None]
"""Hears of each frame: how many are done, and the keyframes that settled."""


class Looped:
    """A sequence played back and forth until `count` frames were shown."""

    def __init__(self, dataset: Dataset, count: int) -> None:
        self._dataset, self._count = dataset, count
        self.name, self.camera = f"{dataset.name}, back and forth", dataset.camera
        self._period = int(np.median(np.diff(dataset.timestamps_ns)))

    def __len__(self) -> int:
        return self._count

    def read(self, index: int) -> Frame | Unreadable:
        """Frame `index` of the loop, with a number and a time of its own."""
        turn = 2 * (len(self._dataset) - 1)
        at = index % turn
        frame = self._dataset.read(min(at, turn - at))
        return frame if isinstance(frame, Unreadable) else dataclasses.replace(frame, index=index, timestamp_ns=index * self._period)


def timed_slam(dataset: Dataset | Looped, config: Config, rival: StepTimes | None) -> Slam:
    """A `Slam` that times its steps by CPU, and solves some of its windows by the Schur complement too, for comparison only."""
    schur, count = dataclasses.replace(config.bundle_adjustment, keyframe_solver="schur"), itertools.count(1)

    def solve(
        problem: BundleProblem, camera: Camera, settings: BundleAdjustmentConfig, prior: CameraPrior | None = None
    ) -> tuple[BundleProblem, BundleReport]:
        if rival is not None and next(count) % SCHUR_INTERVAL == 0:
            with rival.timed(SCHUR):
                adjust_bundle(problem, camera, schur, prior)
        return adjust_bundle(problem, camera, settings, prior)

    slam = Slam(dataset.camera, config, steps=SlamSteps(solve=solve))
    slam.times.clock = time.thread_time
    return slam


@dataclasses.dataclass
class Measured:
    """What a benchmark gathers."""

    front_end: FrontEnd
    slam: Slam
    others: StepTimes
    live_points: list[int]
    sparse_seconds: float = 0.0
    """CPU of front end, tracking and mapping, with decoding, without rivals."""
    dense_seconds: float = 0.0


def run_sparse(dataset: Dataset | Looped, frames: int, config: Config, with_rivals: bool, tell: Telling) -> Measured:
    """The sparse half, step by step; KLT and Schur in between where wanted."""
    cv2.setNumThreads(1)
    keep_freed_memory()  # as the command line does
    others = StepTimes(clock=time.thread_time)
    made = Measured(FrontEnd(config), timed_slam(dataset, config, others if with_rivals else None), others, [])
    made.front_end.times.clock = time.thread_time
    previous: Frame | None = None
    for index in range(frames):
        with others.timed(DECODING):
            frame = dataset.read(index)
        if isinstance(frame, Unreadable):
            continue
        if previous is not None and with_rivals:
            points = made.slam.tracks.pixels
            others.add(KLT, klt_milliseconds(previous.image, frame.image, points, time.thread_time) / 1e3)
        begun = time.thread_time()
        made.slam.process_frame(made.front_end.process(frame))
        settled = made.slam.take_settled_keyframes()
        made.sparse_seconds += time.thread_time() - begun
        made.live_points.append(int((made.slam.tracks.missed == 0).sum()))
        tell(index + 1, made.slam, settled)
        previous = frame
    begun = time.thread_time()
    made.slam.finish()
    made.sparse_seconds += time.thread_time() - begun + sum(others.milliseconds[DECODING]) / 1e3
    made.sparse_seconds -= sum(others.milliseconds.get(SCHUR, [])) / 1e3
    return made


def run_dense(dataset: Dataset, made: Measured, config: Config, scale: Scale) -> Reconstruction:
    """The dense half over all keyframes of the finished map."""
    reconstruction = Reconstruction(made.slam.camera, with_voxels(config, scale), num_keyframes=made.slam.map.num_keyframes)
    reconstruction.times.clock = time.thread_time
    begun = time.thread_time()
    by_row, count = information_by_row(made.slam.map, made.slam.camera), made.slam.map.num_keyframes
    extra_seconds = 0.0
    for keyframe, index in enumerate(made.slam.map.frame_indices):
        frame = dataset.read(index)
        if not isinstance(frame, Unreadable):
            with reconstruction.times.timed("snapshot"):
                snapshot = made.slam.snapshot(keyframe, frame, by_row)
            reconstruction.add_keyframe(snapshot)
        if keyframe % (1 + count // EXTRACTIONS) == count // EXTRACTIONS and reconstruction.volumes.low is not None:
            extra_seconds += extraction_seconds(reconstruction)
    reconstruction.surfaces()
    made.dense_seconds = time.thread_time() - begun - extra_seconds
    return reconstruction


def extraction_seconds(reconstruction: Reconstruction) -> float:
    """Extracts both surfaces as they are by now, timed as steps; what it took."""
    begun = time.thread_time()
    reconstruction.volumes.surfaces()
    return time.thread_time() - begun


def benchmark(dataset: Dataset, frames: int | None, config: Config) -> dict[str, Any]:
    """All figures as a JSON object."""
    warm_up([config])
    count = min(len(dataset), frames or len(dataset))
    made = run_sparse(dataset, count, config, True, lambda done, slam, settled: None)
    if made.slam.map.num_keyframes == 0:
        raise InputError(f"{dataset.name}: no map: {made.slam.initializer.reason}")
    has_truth = dataset.ground_truth() is not None
    scale = scale_from_ground_truth(made.slam.trajectory(), dataset.ground_truth()) if has_truth else Scale()
    reconstruction = run_dense(dataset, made, config, scale)
    steps = step_table(made.front_end.times, made.slam.times, reconstruction.times, made.others)
    return {
        "source": dataset.name,
        "picture": [dataset.camera.width, dataset.camera.height],
        "mode": config.mode,
        "frames": count,
        "processed_frames": len(made.live_points),
        "keyframes": made.slam.map.num_keyframes,
        "landmarks": len(made.slam.map.landmarks),
        "live_points": float(np.median(made.live_points)),
        "voxels": [scale.metres_per_unit * length for length in reconstruction.volumes.voxel_lengths()],
        "unit": scale.unit if scale.is_known else "map unit",
        "rows": rows(made, reconstruction),
        "steps": steps,
        "sparse_cpu_seconds": made.sparse_seconds,
        "dense_cpu_seconds": made.dense_seconds,
        "frames_per_cpu_second": len(made.live_points) / made.sparse_seconds,
        "peak_memory_mb": peak_memory_mb(),
        "processor": processor(),
        "load": [round(load, 2) for load in os.getloadavg()],
        "versions": versions(),
    }


def rows(made: Measured, reconstruction: Reconstruction) -> dict[str, dict[str, float]]:
    """The rows of Table 3, median and p95: steps of one frame, or keyframe, added up where all of them ran."""
    milliseconds = {**made.front_end.times.milliseconds, **made.slam.times.milliseconds, **reconstruction.times.milliseconds}
    found = {}
    for row, (names, _) in PARTS.items():
        series = [np.asarray(milliseconds[name]) for name in names if milliseconds.get(name)]
        extraction = [s for s, name in zip(series, (n for n in names if milliseconds.get(n)), strict=True) if name.startswith("surface")]
        per_item = [s for s in series if not any(s is e for e in extraction)]
        length = max((len(s) for s in per_item), default=0)
        summed = np.zeros(length)
        for one in per_item:  # shorter ones started later (after the initialisation), or run in some frames only
            summed[length - len(one) :] += one
        summed += sum(float(np.median(e)) for e in extraction)
        found[row] = {"median_ms": float(np.median(summed)), "p95_ms": float(np.percentile(summed, 95))} if length else {}
        if length and extraction:
            found[row]["at_the_end_ms"] = found[row]["median_ms"] + sum(float(e[-1] - np.median(e)) for e in extraction)
    return found


def peak_memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def resident_mb() -> float:
    """Memory of this process now (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def processor() -> str:
    """Its name (Linux), or what Python knows."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())


# --- a run without end ---------------------------------------------------------------------------------------------


def loop(dataset: Dataset, frames: int, config: Config, with_dense: bool = False) -> dict[str, Any]:
    """Memory and the size of the map in the course of a long run of the sparse half, or of both."""
    course: list[dict[str, float]] = []
    reconstruction = Reconstruction(dataset.camera, config)

    def tell(done: int, slam: Slam, settled: list[tuple[int, Frame]]) -> None:
        for keyframe, frame in settled if with_dense else []:
            reconstruction.add_keyframe(slam.snapshot(keyframe, frame))
        if done % MEMORY_INTERVAL == 0 or done == frames:
            landmarks = len(slam.map.landmarks)
            course.append(
                {
                    "frames": done,
                    "resident_mb": round(resident_mb(), 1),
                    "keyframes": slam.map.num_keyframes,
                    "landmarks": landmarks,
                    "observations": len(slam.map.obs_landmark),
                    "tracked": len(slam.poses),
                    "views": len(reconstruction.volumes.median_depths),
                    "cpu_seconds": round(time.process_time(), 1),
                }
            )
            if done % (4 * MEMORY_INTERVAL) == 0:
                print(json.dumps(course[-1]), file=sys.stderr, flush=True)

    warm_up([config])
    made = run_sparse(Looped(dataset, frames), frames, config, False, tell)
    tracked = len(made.slam.poses) / frames
    triangles = [len(surface.triangles) for surface in reconstruction.surfaces()] if with_dense else []
    figures = {"source": dataset.name, "frames": frames, "tracked": tracked, "triangles": triangles, "course": course}
    return figures | {"peak_memory_mb": peak_memory_mb(), "versions": versions()}


def loop_plot(figures: dict[str, Any]) -> str:
    """Memory over frames: SVG."""
    frames = np.array([c["frames"] for c in figures["course"]])
    lines = [Line("memory", frames, np.array([c["resident_mb"] for c in figures["course"]]))]
    return line_plot(Axes(f"{figures['source']}, back and forth", "frames", "resident memory [MB]", from_zero=True), lines)


# --- words ---------------------------------------------------------------------------------------------------------


def table(figures: dict[str, Any]) -> str:
    """The figures for people: Tables 2 and 3 with the paper's, the steps, the rivals, the sums."""
    width, height = figures["picture"]
    low, high = figures["voxels"]
    lines = [
        f"{figures['source']}: {figures['processed_frames']} frames of {width}×{height}, {figures['live_points']:.0f} live points, "
        f"{figures['keyframes']} keyframes, {figures['landmarks']} landmarks, voxels {low:.3g} and {high:.3g} {figures['unit']}s",
        f"{figures['processor']}; load {figures['load']}; CPU milliseconds on one thread",
        "",
        f"{'':44}{'median':>9}{'p95':>9}{'paper':>9}",
    ]
    tracking = figures["rows"]["feature tracking, per frame"]
    others = ", ".join(f"{name} {ms:.0f}" for name, ms in TABLE_2_MS.items())
    lines += [f"Table 2: tracking {tracking.get('median_ms', np.nan):.1f} ms per frame ({others})", "Table 3"]
    for row, ms in TABLE_3_MS.items():
        ours = figures["rows"].get(row, {})
        at_the_end = f"   at the end {ours['at_the_end_ms']:.0f}" if "at_the_end_ms" in ours else ""
        lines.append(f"  {row:42}{ours.get('median_ms', np.nan):9.2f}{ours.get('p95_ms', np.nan):9.2f}{ms:9.0f}{at_the_end}")
    lines.append("Steps")
    lines += [f"  {name:42}{s['median_ms']:9.2f}{s['p95_ms']:9.2f}{s['count']:9}×" for name, s in figures["steps"].items()]
    sparse, dense = figures["sparse_cpu_seconds"], figures["dense_cpu_seconds"]
    lines.append(
        f"CPU seconds: sparse half {sparse:.1f} ({figures['frames_per_cpu_second']:.0f} frames per CPU second), dense half {dense:.1f}, "
        f"both {sparse + dense:.1f}; peak memory {figures['peak_memory_mb']:.0f} MB"
    )
    return "\n".join(lines)


def comparison(new: dict[str, Any], old: dict[str, Any]) -> str:
    """New figures beside those of an earlier JSON, with their ratio."""
    pairs = [(row, new["rows"][row].get("median_ms"), old["rows"].get(row, {}).get("median_ms")) for row in new["rows"]]
    pairs += [(name, step["median_ms"], old["steps"].get(name, {}).get("median_ms")) for name, step in new["steps"].items()]
    pairs += [(name, new[name], old.get(name)) for name in ("sparse_cpu_seconds", "dense_cpu_seconds", "live_points", "peak_memory_mb")]
    lines = [f"{'against the earlier figures':44}{'new':>9}{'old':>9}{'new/old':>9}"]
    for name, a, b in pairs:
        if a is not None and b:
            lines.append(f"  {name:42}{a:9.2f}{b:9.2f}{a / b:9.2f}")
    return "\n".join(lines)


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, nargs="?", default=DEMO, help="a sequence; default: data/demo")
    parser.add_argument("--calibration", type=Path, help="of the source, where it brings none")
    parser.add_argument("--frames", type=int, metavar="N", help="at most so many; default: all")
    parser.add_argument("--mode", choices=("default", "paper"), default="default")
    parser.add_argument("--live", action="store_true", help="the settings of --live")
    parser.add_argument("--config", type=Path, help="settings as TOML")
    parser.add_argument("--loop", type=int, metavar="N", help="N frames back and forth: the course of memory")
    parser.add_argument("--dense", action="store_true", help="of --loop: mesh and fuse as well")
    parser.add_argument("--plot", type=Path, metavar="SVG", help="of --loop")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--against", type=Path, metavar="FILE", help="compare with an earlier --json")
    return parser.parse_args(argv)


def _earlier(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable JSON file of this tool ({error})") from None
    if "rows" not in found or "steps" not in found:
        raise InputError(f"{path}: not written by this tool's --json")
    return found


def main(argv: list[str] | None = None) -> int:
    """Measures and prints; 2 with one line for bad input."""
    arguments = parsed(argv)
    try:
        earlier = _earlier(arguments.against) if arguments.against else None
        config = paper_config() if arguments.mode == "paper" else Config()
        config = live_config(config) if arguments.live or arguments.loop else config
        config = load_toml(arguments.config, config) if arguments.config else config
        dataset = open_dataset(arguments.source, arguments.calibration)
        if min(arguments.loop or 2, arguments.frames or 2) < 2:
            raise InputError("--frames and --loop: at least 2")
        frames = arguments.loop or arguments.frames
        figures = loop(dataset, frames, config, arguments.dense) if arguments.loop else benchmark(dataset, frames, config)
        if arguments.plot and arguments.loop:
            write_file(arguments.plot, [loop_plot(figures).encode()])
        if arguments.json:
            write_file(arguments.json, [(json.dumps(figures, indent=1) + "\n").encode()])
    except Vitamin3dError as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 2
    print(json.dumps(figures["course"][-1]) if arguments.loop else table(figures))
    if earlier is not None and not arguments.loop:
        print("\n" + comparison(figures, earlier))
    return 0


if __name__ == "__main__":
    sys.exit(main())
