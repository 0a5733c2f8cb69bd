# SPDX-License-Identifier: Apache-2.0
"""Measures the bundle adjustment: BAL problems, windows recorded from a real run, a whole map; one core.

    python tools/benchmark_bundle_adjustment.py bal problem-16-22106-pre.txt.bz2 problem-49-7776-pre.txt.bz2
    python tools/benchmark_bundle_adjustment.py record SEQUENCE WINDOWS --keyframes 12 --anchors 15
    python tools/benchmark_bundle_adjustment.py windows WINDOWS/window_*.npz
    python tools/benchmark_bundle_adjustment.py map WINDOWS/map.npz

`bal` and `map` also run Ceres by way of pycolmap (`pip install 'vitamin3d[reference]'`) in the same process, on the same core,
from the same start, where it is installed. Times are of the CPU, the least of several runs of the whole call, setup included.
`record` also saves the true poses and points where the sequence has exact ones; `windows` then says when the errors are within 5 % of
the optimum's.
"""

import argparse
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.bundle_adjustment.adjust import SOLVERS, AdjustmentSettings, adjust, adjust_bundle
from vitamin3d.bundle_adjustment.marginalization import CameraPrior
from vitamin3d.bundle_adjustment.problem import BundleProblem, make_problem
from vitamin3d.bundle_adjustment.rejection import reject
from vitamin3d.bundle_adjustment.self_calibration import adjust_with_intrinsics
from vitamin3d.bundle_adjustment.subspace import new_scratch, sweep_cameras, sweep_points
from vitamin3d.bundle_adjustment.variables import Variables, free_slots, pinhole_model, sightings_of
from vitamin3d.config import BundleAdjustmentConfig, Config
from vitamin3d.datasets import Dataset, Unreadable, open_dataset
from vitamin3d.datasets.bal import read_bal
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.evaluation.reference_surface import depth_maps, read_depth
from vitamin3d.geometry.cameras import Camera, PinholeCamera
from vitamin3d.geometry.se3 import exp_se3, inverse, log_so3, transform_points
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.mapping.window_selection import build_problem, select_window, whole_map
from vitamin3d.slam import Slam
from vitamin3d.slam_steps import SlamSteps
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Array, BundleReport

REPEATS = 5
NEAR_SHARE, POSE_SHARE = 0.01, 0.05
MOVED_M, TURNED_DEG, DEPTH_SHARE = 0.01, 0.5, 0.02
"""How a window's start is perturbed: camera centres, rotations, depths from the first camera that sees a point; one deviation each."""


def least_seconds(function: Callable[[], Any], repeats: int = REPEATS) -> tuple[float, Any]:
    """Seconds of the CPU of the fastest of several calls, and its result."""
    best, result = np.inf, None
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        best = min(best, time.process_time() - start)
    return best, result


# --- BAL ---------------------------------------------------------------------------------------------------------


def compare_on_bal(path: Path) -> None:
    """Half the sum of squares at the end, and the time until it is within a hundredth of that."""
    problem, models = read_bal(path)
    problem, rejection = reject(problem, models)
    print(f"{path.name}: {len(models)} cameras, {len(problem.obs_pixels)} observations; left out: {rejection.summary() or 'nothing'}")
    ceres = ceres_solver()
    best = None
    if ceres:
        run = ceres(problem, models)
        best = run.cost
        near = next(r for k in range(1, 100) if (r := ceres(problem, models, iterations=k)).cost <= (1.0 + NEAR_SHARE) * best)
        _row("ceres", run.cost, run.iterations, run.seconds, near.iterations, near.seconds)
    for name in ("schur", "subspace-accelerated"):
        settings = AdjustmentSettings(name, np.inf, iterations=100, relative_gain=1e-7, free=("f", "k1", "k2"), own=True)
        seconds, adjusted = least_seconds(partial(adjust, problem, models, settings))
        costs = 0.5 * adjusted.report.costs
        steps = int(np.flatnonzero(costs <= (1.0 + NEAR_SHARE) * (best or costs[-1]))[0])
        short = dataclasses.replace(settings, iterations=steps)
        near_seconds, _ = least_seconds(partial(adjust, problem, models, short))
        _row(name, costs[-1], len(costs) - 1, seconds, steps, near_seconds)


def _row(name: str, cost: float, steps: int, seconds: float, near_steps: int, near_seconds: float) -> None:
    print(f"  {name:22} cost {cost:12.2f} in {steps:3} steps, {1e3 * seconds:7.1f} ms; ", end="")
    print(f"within 1 % in {near_steps:2} steps, {1e3 * near_seconds:7.1f} ms")


def ceres_solver() -> Callable[..., Any] | None:
    """`solve_with_ceres` where pycolmap is installed."""
    try:
        import pycolmap  # type: ignore[import-not-found,unused-ignore]  # noqa: F401
    except ImportError:
        print("  (pycolmap is not installed: no reference)")
        return None
    from bundle_adjustment_ceres import solve_with_ceres

    return solve_with_ceres


# --- windows of a real run ---------------------------------------------------------------------------------------


class SequenceTruth:
    """True poses of a sequence and its depth maps."""

    def __init__(self, dataset: Dataset, folder: Path) -> None:
        self.trajectory, self.camera = dataset.ground_truth(), dataset.camera
        self.depth_of_time = {depth.timestamp_ns: depth for depth in depth_maps(folder, dataset)}

    def of(self, problem: BundleProblem, times_ns: Array, camera: Camera) -> tuple[Array, Array] | None:
        """T_world_cam (C, 4, 4) and points (P, 3), NaN where no camera with a depth map sees it; None without true poses."""
        if self.trajectory is None or not np.isin(times_ns, self.trajectory.timestamps_ns).all():
            return None
        T_world_cam = self.trajectory.T_world_cam[np.searchsorted(self.trajectory.timestamps_ns, times_ns)]
        points = np.full(problem.points_world.shape, np.nan)
        for c in (c for c, t in enumerate(times_ns) if int(t) in self.depth_of_time):
            rows = np.flatnonzero(problem.obs_camera == c)
            ideal = problem.obs_pixels[rows]
            u, v = np.round(camera.distort(ideal)).astype(int).T
            z = read_depth(self.depth_of_time[int(times_ns[c])], self.camera)[v, u]
            points[problem.obs_point[rows]] = transform_points(
                T_world_cam[c], camera.rays_from_ideal(ideal) * np.where(z > 0, z, np.nan)[:, None]
            )
        return T_world_cam, points


def record(source: str, folder: Path, keyframes: int, anchors: int, every: int, frames: int) -> None:
    """Runs the sparse half and writes window_*.npz and map.npz, the whole map before its final adjustment."""
    config = Config()
    window = dataclasses.replace(config.window, keyframes=keyframes, anchors=anchors)
    adjustment = dataclasses.replace(config.bundle_adjustment, keyframe_interval=1)  # so that any keyframe may be the one to save
    calibration = dataclasses.replace(config.calibration, refine="off")
    config = dataclasses.replace(config, window=window, bundle_adjustment=adjustment, calibration=calibration)
    dataset = open_dataset(Path(source))
    if isinstance(dataset, Unreadable):
        raise InputError(f"{source}: {dataset.reason}")
    folder.mkdir(parents=True, exist_ok=True)
    truth = SequenceTruth(dataset, Path(source))

    def solve(
        problem: BundleProblem, camera: Camera, settings: BundleAdjustmentConfig, prior: CameraPrior | None = None
    ) -> tuple[BundleProblem, BundleReport]:
        """Saves the problem of the window, as the mapper starts it, at some keyframes; its ideal pixels are of `camera`."""
        count = slam.map.num_keyframes
        if count % every == 0:
            times = np.array(slam.map.timestamps_ns, np.int64)[select_window(slam.map, config.window).keyframes]
            save_problem(folder / f"window_{count:04d}.npz", problem, camera, truth.of(problem, times, camera))
        return adjust_bundle(problem, camera, settings, prior)

    slam = Slam(dataset.camera, config, steps=SlamSteps(solve=solve))
    front_end = FrontEnd(config)
    for index in range(min(frames, len(dataset))):
        frame = dataset.read(index)
        if not isinstance(frame, Unreadable):
            slam.process_frame(front_end.process(frame))
    save_problem(folder / "map.npz", build_problem(slam.map, whole_map(slam.map)), slam.camera)


def save_problem(path: Path, problem: BundleProblem, camera: Camera, truth: tuple[Array, Array] | None = None) -> None:
    """Writes a problem in measured pixels with its camera, and true poses and points where they are known."""
    fields = {field.name: getattr(problem, field.name) for field in dataclasses.fields(problem)}
    fields["obs_pixels"] = camera.distort(problem.obs_pixels)
    if truth is not None:
        fields["true_T_world_cam"], fields["true_points"] = truth
    np.savez(path, model=camera.model, size=[camera.width, camera.height], **fields)


def load_problem(path: Path) -> tuple[BundleProblem, Camera]:
    """The problem in ideal pixels, and the camera."""
    with np.load(path) as data:
        width, height = (int(n) for n in data["size"])
        camera = PinholeCamera(1.0, 1.0, 0.0, 0.0, width, height).with_model(data["model"])
        made = make_problem(
            data["T_cam_world"], data["points_world"], data["obs_camera"], data["obs_point"], camera.undistort(data["obs_pixels"]),
            data["camera_is_free"],
        )  # fmt: skip
    return made, camera


def load_truth(path: Path) -> tuple[Array, Array] | None:
    """True poses and points of a recorded window, where it has them."""
    with np.load(path) as data:
        return (data["true_T_world_cam"], data["true_points"]) if "true_points" in data else None


def errors(problem: BundleProblem, truth: tuple[Array, Array]) -> Array:
    """(3,) after a Sim(3) of all centres: RMS of the free cameras' centres in metres and rotations in degrees, median of the points."""
    T_world_cam, points = inverse(problem.T_cam_world), truth[1]
    s, R, t = align_sim3(T_world_cam[:, :3, 3], truth[0][:, :3, 3])
    apart = np.linalg.norm(s * T_world_cam[:, :3, 3] @ R.T + t - truth[0][:, :3, 3], axis=1)
    turns = np.swapaxes(truth[0][:, :3, :3], 1, 2) @ R @ T_world_cam[:, :3, :3]
    angles = np.degrees([np.linalg.norm(log_so3(turn)) for turn in turns])
    of_points = np.linalg.norm(s * problem.points_world @ R.T + t - points, axis=1)
    free = problem.camera_is_free
    return np.array([np.sqrt(np.mean(apart[free] ** 2)), np.sqrt(np.mean(angles[free] ** 2)), np.nanmedian(of_points)])


def perturbed(problem: BundleProblem, metres_per_unit: float, rng: np.random.Generator) -> BundleProblem:
    """Free cameras and all points moved from where they are."""
    poses, points = problem.T_cam_world.copy(), problem.points_world.copy()
    first = problem.obs_camera[problem.point_order[np.minimum(problem.point_starts[:-1], len(problem.point_order) - 1)]]
    centers = inverse(poses)[first, :3, 3]
    points = centers + (points - centers) * (1.0 + DEPTH_SHARE * rng.standard_normal((len(points), 1)))
    for c in np.flatnonzero(problem.camera_is_free):
        T_world_cam = inverse(poses[c])
        turn = exp_se3(np.r_[np.zeros(3), np.radians(TURNED_DEG) * rng.standard_normal(3)])
        T_world_cam = T_world_cam @ turn
        T_world_cam[:3, 3] += MOVED_M / metres_per_unit * rng.standard_normal(3)
        poses[c] = inverse(T_world_cam)
    return dataclasses.replace(problem, T_cam_world=poses, points_world=points)


def distances(a: BundleProblem, b: BundleProblem) -> Array:
    """(3,) RMS distance of the free cameras' centres, RMS angle between them in degrees, median distance of the points."""
    free = a.camera_is_free
    centers = [inverse(p.T_cam_world[free])[:, :3, 3] for p in (a, b)]
    turns = a.T_cam_world[free, :3, :3] @ np.swapaxes(b.T_cam_world[free, :3, :3], 1, 2)
    angles = [np.degrees(np.linalg.norm(log_so3(R))) for R in turns]
    moved = np.linalg.norm(centers[0] - centers[1], axis=1)
    apart = np.linalg.norm(a.points_world - b.points_world, axis=1)
    return np.array([np.sqrt(np.mean(moved**2)), np.sqrt(np.mean(np.square(angles))), np.median(apart)])


def compare_on_window(path: Path, metres_per_unit: float, sigma_px: float) -> None:
    """Until the camera centres, rotations and points have come within a twentieth of their start's distance from the optimum."""
    problem, camera = load_problem(path)
    print(_size(path, problem))
    optimum, _ = SOLVERS["schur"](problem, camera, sigma_px, 200, 1e-10)
    truth = load_truth(path)
    if truth is not None:
        print(f"  errors of the optimum: {_said(errors(optimum, truth))}")
    for start_name, start in (("live", problem), ("perturbed", perturbed(problem, metres_per_unit, np.random.default_rng(0)))):
        before = distances(start, optimum)
        print(f"  {start_name} start, away from the optimum: {before[0]:.4g} units, {before[1]:.3g}°, points {before[2]:.4g}")
        if truth is not None:
            print(f"    errors: {_said(errors(start, truth))}")
        for name, limit in (("subspace", 400), ("subspace-inner", 80), ("subspace-accelerated", 30), ("schur", 30)):
            told = _time_to_arrive(name, start, optimum, before, camera, sigma_px, limit)
            if truth is not None:
                told += f"; errors within 5 % after {_time_to_errors(name, start, errors(optimum, truth), truth, camera, sigma_px, limit)}"
            print(f"    {name:22} {told}")


def _size(path: Path, problem: BundleProblem) -> str:
    free, all_ = int(problem.camera_is_free.sum()), len(problem.camera_is_free)
    counts = f"{len(problem.points_world)} landmarks, {len(problem.obs_pixels)} observations"
    return f"{path.name}: {free} free and {all_ - free} fixed keyframes, {counts}"


def _time_to_arrive(
    name: str, start: BundleProblem, optimum: BundleProblem, before: Array, camera: Camera, sigma_px: float, limit: int
) -> str:
    for steps in _growing(limit):
        solved, _ = SOLVERS[name](start, camera, sigma_px, steps, 0.0)
        left = distances(solved, optimum) / np.maximum(before, 1e-12)
        if left.max() <= POSE_SHARE:
            seconds, _ = least_seconds(partial(SOLVERS[name], start, camera, sigma_px, steps, 0.0))
            return f"{steps:3} steps, {1e3 * seconds:7.1f} ms"
    seconds, _ = least_seconds(partial(SOLVERS[name], start, camera, sigma_px, limit, 0.0), 1)
    shares = f"{left[0]:.0%} of the way, {left[1]:.0%} of the angle, {left[2]:.0%} at points"
    return f"not in {limit} steps, {1e3 * seconds:.0f} ms: left are {shares}"


def _said(found: Array) -> str:
    return f"centres {1e3 * found[0]:.2f} mm, rotations {found[1]:.4f}°, points {1e3 * found[2]:.2f} mm"


def _time_to_errors(
    name: str, start: BundleProblem, best: Array, truth: tuple[Array, Array], camera: Camera, sigma_px: float, limit: int
) -> str:
    for steps in _growing(limit):
        solved, _ = SOLVERS[name](start, camera, sigma_px, steps, 0.0)
        if (errors(solved, truth) <= (1.0 + POSE_SHARE) * best).all():
            seconds, _ = least_seconds(partial(SOLVERS[name], start, camera, sigma_px, steps, 0.0))
            return f"{steps} steps, {1e3 * seconds:.1f} ms"
    return f"more than {limit} steps"


def _growing(limit: int) -> Iterator[int]:
    """1, 2, 3, ... in steps that grow by a fifth."""
    steps = 1
    while steps <= limit:
        yield steps
        steps = max(steps + 1, int(1.2 * steps))


def sweep_throughput(path: Path) -> None:
    """Observations per second of a sweep over cameras and points, all cameras free."""
    problem, camera = load_problem(path)
    problem = dataclasses.replace(problem, camera_is_free=np.ones(len(problem.T_cam_world), np.bool_))
    variables, scratch = Variables.of(problem, pinhole_model(camera)), new_scratch()
    views, sightings = variables.views(free_slots(problem)), sightings_of(problem)
    cameras, _ = least_seconds(lambda: sweep_cameras(views, sightings, variables.points, 0.25, scratch), 20)
    points, _ = least_seconds(lambda: sweep_points(views, sightings, variables.points, 0.25), 20)
    count = len(problem.obs_pixels)
    print(f"{path.name}: {1e9 * cameras / count:.1f} + {1e9 * points / count:.1f} ns, {1e-6 * count / (cameras + points):.1f} million/s")


def adjust_map(path: Path, sigma_px: float) -> None:
    """The whole map with f k1 k2 shared and free; Ceres with a Cauchy loss of the same scale."""
    problem, camera = load_problem(path)
    print(_size(path, problem))
    seconds, (_, found, report) = least_seconds(partial(adjust_with_intrinsics, problem, camera, ("f", "k1", "k2"), sigma_px, 100), 2)
    deviation = report.deviations["f"]
    _print_map("ours", seconds, len(report.costs) - 1, found.model, f" ({report.stopped}, deviation of f {deviation:.2f})")
    ceres = ceres_solver()
    if ceres and camera.parameters["p1"] == camera.parameters["p2"] == 0.0:
        measured = dataclasses.replace(problem, obs_pixels=camera.distort(problem.obs_pixels))
        run = ceres(measured, camera.model[None], sigma_px, 100, 1e-6)
        _print_map("ceres", run.seconds, run.iterations, run.models[0], "")


def _print_map(name: str, seconds: float, steps: int, model: Array, more: str) -> None:
    print(f"  {name:6} {seconds:6.2f} s, {steps:3} steps: f {model[0]:.2f}, k1 {model[4]:.4f}, k2 {model[5]:.4f}{more}")


def parsed(argv: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("bal", "windows", "sweeps", "map"):
        command = commands.add_parser(name)
        command.add_argument("files", type=Path, nargs="+")
        command.add_argument("--sigma", type=float, default=2.0 if name == "windows" else 1.0, help="of the robust kernel, pixels")
        command.add_argument("--metres-per-unit", type=float, default=2.0, help="of the recorded map, for the perturbation")
    command = commands.add_parser("record")
    command.add_argument("source")
    command.add_argument("folder", type=Path)
    for name, default in (("keyframes", 12), ("anchors", 15), ("every", 30), ("frames", 10**9)):
        command.add_argument(f"--{name}", type=int, default=default)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 2 for bad input."""
    arguments = parsed(argv)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    try:
        if arguments.command == "record":
            record(arguments.source, arguments.folder, arguments.keyframes, arguments.anchors, arguments.every, arguments.frames)
        for path in arguments.files if arguments.command != "record" else []:
            if arguments.command == "bal":
                compare_on_bal(path)
            elif arguments.command == "windows":
                compare_on_window(path, arguments.metres_per_unit, arguments.sigma)
            elif arguments.command == "sweeps":
                sweep_throughput(path)
            else:
                adjust_map(path, arguments.sigma)
    except Vitamin3dError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
