# SPDX-License-Identifier: Apache-2.0
"""The readout time of a rolling shutter from the map: the adjusted cost at three readout times is a parabola.

Each measured pixel is carried to the middle row's moment by readout × shift. So the best readout time is where poses and points,
adjusted to the pixels so carried, leave the least cost; the bend there says how well it is known.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem, points_of_long_tracks, select_points
from vitamin3d.bundle_adjustment.schur import adjust_schur
from vitamin3d.config import CalibrationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.rolling_shutter import ideal_pixels, measured_pixels
from vitamin3d.mapping.window_selection import Window, build_problem
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, BundleReport

STEP_IN_INTERVALS = 0.2
"""Between the readout times tried, in intervals between two frames."""
SEARCHES = 6
FARTHEST_STEPS = 2.0
"""The parabola is believed no farther from its middle than so many steps."""
BLOCK_KEYFRAMES = 60
ITERATIONS = 10
RELATIVE_GAIN = 1e-5


@dataclass(frozen=True)
class ReadoutEstimate:
    """What the map says about the readout time."""

    readout_s: float
    deviation_s: float
    """Standard deviation for independent errors; inf where nothing moves or the search found no end."""


def frame_interval_s(sparse_map: SparseMap) -> float:
    """Seconds between two frames, the median over the keyframes; 0 where the map has less than two."""
    frames, times = np.diff(sparse_map.frame_indices), np.diff(sparse_map.timestamps_ns)
    return float(1e-9 * np.median(times / np.maximum(frames, 1))) if len(frames) else 0.0


def estimate_readout(sparse_map: SparseMap, camera: Camera, config: CalibrationConfig) -> ReadoutEstimate:
    """The readout time, searched from the camera's; the map, whose ideal pixels are the camera's, stays as it is."""
    step = STEP_IN_INTERVALS * frame_interval_s(sparse_map)
    found = ReadoutEstimate(camera.readout_s, np.inf)
    if step <= 0 or not sparse_map.image_motions.any():
        return found
    blocks = [_block(sparse_map, int(first), camera, config) for first in _block_starts(sparse_map.num_keyframes, config.readout_blocks)]
    for _ in range(SEARCHES):
        offset, deviation = _parabola([block.costs_around(found.readout_s, step, config.sigma_px) for block in blocks])
        found = ReadoutEstimate(found.readout_s + step * float(np.clip(offset, -FARTHEST_STEPS, FARTHEST_STEPS)), step * deviation)
        if abs(offset) <= 0.5:
            return found
    return ReadoutEstimate(found.readout_s, np.inf)


def _block_starts(num_keyframes: int, most: int) -> Array:
    """First keyframes of at most so many blocks, spread evenly."""
    starts = np.arange(0, num_keyframes, BLOCK_KEYFRAMES)
    return np.asarray(starts[np.linspace(0, len(starts) - 1, min(most, len(starts))).astype(int)])


def _parabola(blocks: list[tuple[Array, BundleReport]]) -> tuple[float, float]:
    """Where the least of the summed costs is, and its standard deviation, both in steps; where it bends downwards, downhill and inf."""
    before, middle, after = sum((costs for costs, _ in blocks), np.zeros(3))
    squares = sum(report.num_observations * report.rmse_px**2 for _, report in blocks)
    bend = before - 2.0 * middle + after
    if not bend > 0.0:
        return float(np.sign(before - after)), np.inf
    noise_px = np.sqrt(0.5 * squares / sum(report.num_observations for _, report in blocks))
    return float(0.5 * (before - after) / bend), float(noise_px / np.sqrt(0.5 * bend))


def set_image_motion(sparse_map: SparseMap, keyframe: int, motion: Array, camera: Camera) -> None:
    """Gives a keyframe a better image motion (6, 2); its ideal pixels follow."""
    rows, old = sparse_map.observations_of(keyframe), sparse_map.image_motions[keyframe].copy()
    sparse_map.image_motions[keyframe] = motion
    if camera.readout_s:
        sparse_map.obs_pixels[rows] = ideal_pixels(measured_pixels(sparse_map.obs_pixels[rows], old, camera), motion, camera)


@dataclass(frozen=True)
class _Block:
    """Some consecutive keyframes and the landmarks that they see most often: of a shutter, each tells as much as the whole map."""

    problem: BundleProblem
    measured: Array
    """(M, 2) pixels of the observations."""
    motions: Array
    """(M, 6, 2)."""
    camera: Camera

    def costs_around(self, readout_s: float, step: float, sigma_px: float) -> tuple[Array, BundleReport]:
        """(3,) costs a step below a readout time, at it, and above; and how the block was adjusted there."""
        middle, report = self._adjusted(self.problem, readout_s, sigma_px)
        before, after = (float(self._adjusted(middle, readout_s + offset, sigma_px)[1].costs[-1]) for offset in (-step, step))
        return np.array([before, report.costs[-1], after]), report

    def _adjusted(self, start: BundleProblem, readout_s: float, sigma_px: float) -> tuple[BundleProblem, BundleReport]:
        pixels = ideal_pixels(self.measured, self.motions, self.camera.with_readout(readout_s))
        pixels = np.where(np.isfinite(pixels), pixels, self.problem.obs_pixels)
        return adjust_schur(dataclasses.replace(start, obs_pixels=pixels), self.camera, sigma_px, ITERATIONS, RELATIVE_GAIN)


def _block(sparse_map: SparseMap, first: int, camera: Camera, config: CalibrationConfig) -> _Block:
    last = min(first + BLOCK_KEYFRAMES, sparse_map.num_keyframes)
    problem = build_problem(sparse_map, Window(np.arange(first, last), last - first, 1))
    problem = select_points(problem, points_of_long_tracks(problem, config.readout_points))
    motions = sparse_map.image_motions[first + problem.obs_camera]
    return _Block(problem, measured_pixels(problem.obs_pixels, motions, camera), motions, camera)
