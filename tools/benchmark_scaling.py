# SPDX-License-Identifier: Apache-2.0
"""How the steps' CPU times grow: with points, pixels, keyframes of a window, and voxels. Four curves in one picture.

    python tools/benchmark_scaling.py SEQUENCE --plot scaling.svg --json scaling.json

Points: prediction and climb of so many random pixels between two frames, beside OpenCV's KLT of the same pixels. Image: the
front end on the resized picture. Window: the adjustment of so many keyframes with their anchors, six iterations, from the
map of the first frames. Voxels: fusing a view, of the same keyframes. Medians of several repetitions, one thread's CPU.
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmark_tracking import DEMO, klt_milliseconds

from vitamin3d.atlas import Atlas
from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.config import Config
from vitamin3d.datasets import Dataset, Unreadable, open_dataset
from vitamin3d.dense.tsdf_fusion import Limits, TsdfVolume
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.exporters.files import write_file
from vitamin3d.exporters.line_plot import Axes, Line, line_plot
from vitamin3d.mapping.window_selection import build_problem, select_window
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.run_statistics import largest_map
from vitamin3d.runtime import run_sequential
from vitamin3d.scale import Scale, scale_from_ground_truth
from vitamin3d.slam import Slam
from vitamin3d.tracking.extrema_tracking import predict_by_dense_flow, track_extrema
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import DepthView, Frame, Tracks

POINTS = (1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
MEGAPIXELS = (0.25, 0.5, 1.0, 2.0, 4.0)
KEYFRAMES = (5, 10, 20, 40)
VOXELS_CM = (20.0, 10.0, 5.0, 2.5, 1.0)
REPETITIONS, VIEWS = 7, 12
Curves = dict[str, list[tuple[float, float]]]
"""Name -> (size, milliseconds)."""


def milliseconds(work: Callable[[], object]) -> float:
    """Median CPU time of one call; one more goes before, uncounted."""
    times = []
    for _ in range(REPETITIONS + 1):
        begun = time.thread_time()
        work()
        times.append(1e3 * (time.thread_time() - begun))
    return float(np.median(times[1:]))


def point_curves(a: Frame, b: Frame, config: Config) -> Curves:
    front_end, rng, curves = FrontEnd(config), np.random.default_rng(0), Curves()
    front_end.process(a)
    front = front_end.process(b)
    if front.dense_flow is None:
        raise InputError("the settings use no dense flow")
    height, width = a.image.shape
    for count in POINTS:
        pixels, zeros = rng.uniform(4, [width - 5, height - 5], (count, 2)), np.zeros(count, np.int32)
        tracks = Tracks(np.arange(count), pixels, zeros.astype(np.float32), zeros, zeros)

        def track(tracks: Tracks = tracks) -> Tracks:
            predicted = predict_by_dense_flow(tracks.pixels, front.dense_flow, config.extrema_tracking.flow_reduction)  # type: ignore[arg-type]
            return track_extrema(tracks, predicted, front.kappa, config.extrema_tracking)

        curves.setdefault("predict and climb", []).append((count, milliseconds(track)))
        klt = [klt_milliseconds(a.image, b.image, pixels, time.thread_time) for _ in range(3)]
        curves.setdefault("OpenCV KLT", []).append((count, float(np.median(klt))))
    return curves


def image_curves(a: Frame, b: Frame, config: Config) -> Curves:
    curves: Curves = {}
    for megapixels in MEGAPIXELS:
        factor = np.sqrt(1e6 * megapixels / a.image.size)
        pictures = [dataclasses.replace(f, image=cv2.resize(f.image, None, fx=factor, fy=factor)) for f in (a, b)]
        front_end = FrontEnd(config)
        front_end.times.clock = time.thread_time
        for index in range(2 * REPETITIONS):
            front_end.process(pictures[index % 2])
        for step, times in front_end.times.milliseconds.items():
            curves.setdefault(step.replace("_", ", "), []).append((megapixels, float(np.median(times[2:]))))
    return curves


def window_curves(slam: Slam) -> Curves:
    curves: Curves = {}
    for keyframes in KEYFRAMES:
        window = select_window(slam.map, dataclasses.replace(slam.config.window, keyframes=keyframes))
        problem = build_problem(slam.map, window)
        for solver in ("subspace-accelerated", "schur"):
            settings = dataclasses.replace(slam.config.bundle_adjustment, keyframe_solver=solver, keyframe_iterations=6, relative_gain=0.0)
            taken = milliseconds(lambda settings=settings, problem=problem: adjust_bundle(problem, slam.camera, settings))  # type: ignore[misc]
            curves.setdefault(solver, []).append((keyframes, taken))
    return curves


def voxel_curves(reconstruction: Reconstruction, views: Sequence[DepthView], scale: Scale) -> Curves:
    curves: Curves = {}
    fusion = reconstruction.volumes.config.fusion
    for centimetres in VOXELS_CM:
        length = centimetres / 100.0 / scale.metres_per_unit
        for backend in ("blocks", "scalable"):
            limits = Limits(fusion.max_relative_deviation, fusion.max_deviation_voxels * length)
            volume, times = TsdfVolume(length, fusion.truncation_voxels * length, limits, backend), []
            for view in views:
                begun = time.thread_time()
                volume.integrate(view, reconstruction.canvas, fusion.max_depth * float(np.median(view.depth[view.depth > 0])))
                times.append(1e3 * (time.thread_time() - begun))
            curves.setdefault(backend, []).append((centimetres, float(np.median(times))))
    return curves


def measured(dataset: Dataset, frames: int) -> dict[str, Curves]:
    """All four groups of curves."""
    cv2.setNumThreads(1)
    config = Config()
    pictures = [f for i in range(min(20, len(dataset))) if not isinstance(f := dataset.read(i), Unreadable)]
    if len(pictures) < 2:
        raise InputError(f"{dataset.name}: no two of the first pictures can be read")
    atlas = Atlas(dataset.camera, config)
    run_sequential(dataset, range(min(frames, len(dataset))), FrontEnd(config), atlas)
    slam = largest_map(atlas)
    if slam.map.num_keyframes < 2 * max(KEYFRAMES[:2]):
        raise InputError(f"{dataset.name}: a map of {slam.map.num_keyframes} keyframes is too small; give more frames")
    truth = dataset.ground_truth()
    scale = scale_from_ground_truth(slam.trajectory(), truth) if truth is not None else Scale()
    reconstruction = Reconstruction(slam.camera, config)
    first = slam.map.num_keyframes // 4
    chosen = [(k, dataset.read(slam.map.frame_indices[k])) for k in range(first, min(first + 3 * VIEWS, slam.map.num_keyframes))]
    snapshots = (slam.snapshot(k, frame) for k, frame in chosen if not isinstance(frame, Unreadable))
    views = list(reconstruction.depth_views(snapshots))[:VIEWS]
    return {
        "points": point_curves(pictures[-2], pictures[-1], config),
        "megapixels": image_curves(pictures[-2], pictures[-1], config),
        "keyframes": window_curves(slam),
        "voxel_cm": voxel_curves(reconstruction, views, scale),
    }


TITLES = {
    "points": ("tracking", "points [thousands]", 1e-3),
    "megapixels": ("front end", "picture [megapixels]", 1.0),
    "keyframes": ("adjustment of a window", "keyframes", 1.0),
    "voxel_cm": ("fusing a view", "voxel [cm]", 1.0),
}


def picture(groups: dict[str, Curves]) -> str:
    """The four plots in one SVG."""
    parts, width, height = [], 520, 300
    for number, (group, curves) in enumerate(groups.items()):
        title, label, factor = TITLES[group]
        lines = [Line(name, factor * np.array(c)[:, 0], np.array(c)[:, 1]) for name, c in curves.items()]
        plot = line_plot(Axes(title, label, "CPU [ms]", width, height, from_zero=True), lines)
        parts.append(plot.replace("<svg", f'<svg x="{number % 2 * width}" y="{number // 2 * height}"', 1))
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * width} {2 * height}" width="{2 * width}" height="{2 * height}">'
    return head + "".join(parts) + "</svg>\n"


def main(argv: list[str] | None = None) -> int:
    """Measures, writes and prints; 2 with one line for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, nargs="?", default=DEMO, help="a sequence; default: data/demo")
    parser.add_argument("--frames", type=int, default=250, help="of the map")
    parser.add_argument("--plot", type=Path, metavar="SVG")
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args(argv)
    try:
        groups: dict[str, Any] = measured(open_dataset(arguments.source), arguments.frames)
        if arguments.plot:
            write_file(arguments.plot, [picture(groups).encode()])
        if arguments.json:
            write_file(arguments.json, [(json.dumps(groups, indent=1) + "\n").encode()])
    except Vitamin3dError as error:
        print(f"benchmark_scaling: {error}", file=sys.stderr)
        return 2
    for group, curves in groups.items():
        for name, curve in curves.items():
            print(f"{group:12}{name:24}" + "".join(f"{x:10g}: {y:7.2f}" for x, y in curve))
    return 0


if __name__ == "__main__":
    sys.exit(main())
