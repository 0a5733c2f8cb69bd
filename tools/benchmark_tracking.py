# SPDX-License-Identifier: Apache-2.0
"""Times our front end against OpenCV's pyramidal KLT on as many points of the same frames, one thread each.

    python tools/benchmark_tracking.py
    python tools/benchmark_tracking.py SEQUENCE --frames 100 --json

Ours: curvature and its extrema, flow, prediction and climb of all tracks, refill, as `Slam` does before a map is there.
KLT: `cv2.calcOpticalFlowPyrLK`, 21×21 windows, three levels, forward only, of our tracks' points of the previous frame
(OpenCV builds both pyramids within the call). The two take turns frame by frame, and turns at going first, so that other
load on the machine hits both. Times are CPU times of the one thread; reading pictures is not timed.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vitamin3d.commands.process import keep_freed_memory
from vitamin3d.config import Config, load_toml, paper_config
from vitamin3d.datasets import Dataset, Unreadable, open_dataset
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.image.extrema import refine_extrema, select_free_extrema
from vitamin3d.tracking.extrema_tracking import predict_by_dense_flow, predict_by_dominant_flow, track_extrema
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Array, Frame, FrontEndFrame, StepTimes, Tracks

DEMO = Path(__file__).resolve().parents[1] / "data" / "demo"
WARM_UP_FRAMES = 6
KLT_WINDOW, KLT_LEVELS = (21, 21), 3
STEPS = {
    "curvature_extrema": "curvature, extrema",
    "flow": "flow",
    "predict_climb": "prediction, climb",
    "refill": "refill (where due)",
    "total": "ours, all of it",
}
"""The steps timed, and their names in the table."""


class Tracker:
    """Tracks extrema without a map, in the steps and the order of `Slam`, and times each step."""

    def __init__(self, config: Config) -> None:
        self.config, self.front_end = config, FrontEnd(config)
        self.front_end.times.clock = time.thread_time
        self.tracks, self.times = Tracks.empty(), StepTimes()
        self._next_id = self._frame_count = 0
        self._newest: int | None = None

    def process(self, frame: Frame) -> None:
        """One frame: curvature, extrema, flow; predict and climb; every few frames refill."""
        start = time.thread_time()
        front = self.front_end.process(frame)
        after_front_end = time.thread_time()
        self.tracks = self._tracked(front)
        after_climb = time.thread_time()
        if self._frame_count % self.config.extrema.refill_interval == 0:
            self._refill(front)
            self.times.add("refill", time.thread_time() - after_climb)
        self._frame_count += 1
        self.times.add("predict_climb", after_climb - after_front_end)
        self.times.add("total", time.thread_time() - start)

    def _tracked(self, front: FrontEndFrame) -> Tracks:
        newest, self._newest = self._newest, front.frame.index
        if front.follows != newest:
            return Tracks.empty()
        if front.dense_flow is not None:
            predicted = predict_by_dense_flow(self.tracks.pixels, front.dense_flow, self.config.extrema_tracking.flow_reduction)
        else:
            predicted = predict_by_dominant_flow(self.tracks.pixels, front.dominant_flow)
        return track_extrema(self.tracks, predicted, front.kappa, self.config.extrema_tracking)

    def _refill(self, front: FrontEndFrame) -> None:
        new = select_free_extrema(front.extrema, self.tracks.pixels, front.kappa.shape, self.config.extrema)
        ids, zeros = np.arange(self._next_id, self._next_id + len(new)), np.zeros(len(new), np.int32)
        self._next_id += len(new)
        born = Tracks(ids, refine_extrema(front.kappa, new), front.kappa[new[:, 1], new[:, 0]], zeros, zeros)
        self.tracks = Tracks.concatenate(self.tracks, born)

    def forget_times(self) -> None:
        """Drops what was timed so far: compilation, cold caches."""
        self.times.milliseconds.clear()
        self.front_end.times.milliseconds.clear()


def klt_milliseconds(previous: Array, current: Array, pixels: Array, clock: Callable[[], float] = time.thread_time) -> float:
    """Time of OpenCV's KLT for pixels (N, 2) of the previous picture."""
    points = np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2)
    start = clock()
    cv2.calcOpticalFlowPyrLK(previous, current, points, None, winSize=KLT_WINDOW, maxLevel=KLT_LEVELS - 1)  # type: ignore[call-overload]
    return 1e3 * (clock() - start)


def benchmark(dataset: Dataset, config: Config, frames: int | None) -> dict[str, Any]:
    """Medians in milliseconds per frame, ours by step, KLT's, and their ratio."""
    cv2.setNumThreads(1)
    keep_freed_memory()  # as the command line does
    tracker, pictures = Tracker(config), readable(dataset, frames)
    previous = warmed_up(tracker, pictures)
    klt, points = [], []
    for turn, frame in enumerate(pictures):
        live = tracker.tracks.pixels
        if turn % 2:
            tracker.process(frame)
        klt.append(klt_milliseconds(previous.image, frame.image, live))
        if not turn % 2:
            tracker.process(frame)
        points.append(len(live))
        previous = frame
    if not klt:
        raise InputError(f"{dataset.name}: too few readable pictures; {WARM_UP_FRAMES} are for warming up")
    return report(dataset, tracker, klt, points)


def readable(dataset: Dataset, frames: int | None) -> Iterator[Frame]:
    """The pictures that can be read, enough for `frames` timed ones; None: all."""
    count = len(dataset) if frames is None else min(len(dataset), WARM_UP_FRAMES + frames)
    return (frame for index in range(count) if not isinstance(frame := dataset.read(index), Unreadable))


def warmed_up(tracker: Tracker, pictures: Iterator[Frame]) -> Frame:
    """Tracks the first pictures both ways without counting their times; the last of them."""
    previous: Frame | None = None
    for _, frame in zip(range(WARM_UP_FRAMES), pictures, strict=False):
        if previous is not None:
            klt_milliseconds(previous.image, frame.image, tracker.tracks.pixels)
        tracker.process(frame)
        previous = frame
    tracker.forget_times()
    if previous is None:
        raise InputError("no picture of the sequence can be read")
    return previous


def report(dataset: Dataset, tracker: Tracker, klt: list[float], points: list[int]) -> dict[str, Any]:
    """The figures as a JSON object."""
    times = {**tracker.front_end.times.milliseconds, **tracker.times.milliseconds}
    ours = {step: float(np.median(values)) for step, values in times.items()}
    height, width = dataset.camera.height, dataset.camera.width
    return {
        "source": dataset.name,
        "picture": [width, height],
        "frames": len(klt),
        "median_points": float(np.median(points)),
        "ours_median_ms": ours,
        "ours_mean_ms": float(np.mean(times["total"])),
        "klt_median_ms": float(np.median(klt)),
        "klt_mean_ms": float(np.mean(klt)),
        "klt_over_ours": float(np.median(klt)) / ours["total"],
    }


def table(figures: dict[str, Any]) -> str:
    """The report for people."""
    width, height = figures["picture"]
    lines = [
        f"{figures['source']}: {figures['frames']} frames of {width}×{height}, {figures['median_points']:.0f} points (median), one thread"
    ]
    lines += [f"  {name:24}{figures['ours_median_ms'][step]:9.2f} ms" for step, name in STEPS.items() if step in figures["ours_median_ms"]]
    lines += [f"  {'OpenCV KLT, as many':24}{figures['klt_median_ms']:9.2f} ms"]
    means = f"means: ours {figures['ours_mean_ms']:.2f} ms, KLT {figures['klt_mean_ms']:.2f} ms"
    return "\n".join([*lines, f"KLT takes {figures['klt_over_ours']:.2f} times as long (medians per frame; {means})"])


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, nargs="?", default=DEMO, help="a sequence; default: data/demo")
    parser.add_argument("--calibration", type=Path, help="of the source, where it brings none")
    parser.add_argument("--frames", type=int, metavar="N", help=f"timed frames, after {WARM_UP_FRAMES} for warming up; default: all")
    parser.add_argument("--mode", choices=("default", "paper"), default="default")
    parser.add_argument("--config", type=Path, help="settings as TOML")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Times both and prints; 2 with one line for bad input."""
    arguments = parsed(argv)
    try:
        if arguments.frames is not None and arguments.frames < 1:
            raise InputError(f"--frames: must be positive, not {arguments.frames}")
        config = paper_config() if arguments.mode == "paper" else Config()
        config = load_toml(arguments.config, config) if arguments.config else config
        figures = benchmark(open_dataset(arguments.source, arguments.calibration), config, arguments.frames)
    except Vitamin3dError as error:
        print(f"benchmark_tracking: {error}", file=sys.stderr)
        return 2
    print(json.dumps(figures) if arguments.json else table(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
