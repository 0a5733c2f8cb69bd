# SPDX-License-Identifier: Apache-2.0
"""Where extrema are lost on their way to good landmarks: a funnel of numbers, and the reason of each track's end.

    python tools/landmark_funnel.py SEQUENCE [SEQUENCE ...] [--frames 300] [--config SETTINGS.toml] [--output funnel.md]

A track is counted once, when it was detected; what became of its landmark is asked of the finished map.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.config import Config, load_toml
from vitamin3d.datasets import Unreadable, open_dataset
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.exporters.files import write_file
from vitamin3d.geometry.cameras import Camera
from vitamin3d.localization.localizer import Localizer
from vitamin3d.mapping.landmark_statistics import landmark_information, landmark_statistics, relative_depth_deviations
from vitamin3d.slam import Slam
from vitamin3d.slam_steps import SlamSteps
from vitamin3d.tracking.extrema_tracking import predict_by_dense_flow
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.tracking.tracker import Tracker, TrackIds
from vitamin3d.types import Array, FrontEndFrame, Tracks

STAGES = (
    "detected",
    "seen in 3 frames",
    "mapped",
    "landmark at the end",
    "3 keyframes",
    "parallax > 2°",
    "parallax > 5°",
    "deviation < 5 %",
)
REASONS = (
    "left the picture",
    "extremum vanished or beyond the gate",
    "met another track",
    "reprojection error",
    "outlier of an adjustment",
    "gave way to a landmark found again",
    "became one with another landmark",
    "camera jumped or lost",
)
MIN_FRAMES, MAX_DEVIATION, BORDER_PX = 3, 0.05, 2.0


class FunnelTracker(Tracker):
    """`Tracker` that keeps account of why tracks end."""

    def __init__(self, camera: Camera, config: Config, ids: TrackIds | None = None) -> None:
        super().__init__(camera, config, ids)
        self.ends: Counter[str] = Counter()
        self.second_lives = 0
        """Landmarks found again after their track had ended, tracks that go on after another picture came between."""
        self.reason_of_ends = REASONS[4]
        self._known, self._followed = self.tracks.ids, self.tracks

    def _account(self, reason: str) -> None:
        """Books the tracks that are gone since the last time under a reason, and those that have come as second lives."""
        self.ends[reason] += len(np.setdiff1d(self._known, self.tracks.ids))
        self.second_lives += len(np.setdiff1d(self.tracks.ids, self._known))
        self._known = self.tracks.ids

    def _resume(self, front: FrontEndFrame) -> bool:
        is_resumed = super()._resume(front)
        self.tracks = self.tracks if is_resumed else Tracks.empty()
        self._account(REASONS[7])
        return is_resumed

    def follow(self, front: FrontEndFrame, measures_motion: bool) -> tuple[int, Array] | None:
        self._followed, config = Tracks.empty(), self.config.extrema_tracking
        motion = super().follow(front, measures_motion)
        before = self._followed
        lost = ~np.isin(before.ids, self.tracks.ids)
        predicted = before.pixels
        if front.dense_flow is not None:
            predicted = predict_by_dense_flow(before.pixels, front.dense_flow, config.flow_reduction)
        height, width = front.kappa.shape
        left = lost & ~((predicted > BORDER_PX).all(axis=1) & (predicted < [width - 1 - BORDER_PX, height - 1 - BORDER_PX]).all(axis=1))
        vanished = lost & ~left & (before.missed == config.coast_frames)
        self.ends.update({REASONS[0]: int(left.sum()), REASONS[1]: int(vanished.sum()), REASONS[2]: int((lost & ~left & ~vanished).sum())})
        self._known = self.tracks.ids
        return motion

    def climb(self, predicted: Array, front: FrontEndFrame) -> Tracks:
        self._followed = self.tracks
        return super().climb(predicted, front)

    def refill(self, front: FrontEndFrame) -> None:
        super().refill(front)
        self._known = self.tracks.ids

    def take_up(self, tracks: Tracks) -> None:
        is_merge = tracks.pixels is self.tracks.pixels
        super().take_up(tracks)
        self._account(REASONS[6] if is_merge else REASONS[5])

    def end(self, ids: Array) -> None:
        super().end(ids)
        self._account(self.reason_of_ends)

    def end_all(self) -> None:
        super().end_all()
        self._account(REASONS[7])


class FunnelLocalizer(Localizer):
    """`Localizer` whose outliers are booked as such."""

    tracker: FunnelTracker

    def locate(self, front: FrontEndFrame) -> Array | None:
        with self._booking():
            return super().locate(front)

    def refine(self, T_cam_world: Array) -> Array:
        with self._booking():
            return super().refine(T_cam_world)

    @contextmanager
    def _booking(self) -> Iterator[None]:
        before, self.tracker.reason_of_ends = self.tracker.reason_of_ends, REASONS[3]
        yield
        self.tracker.reason_of_ends = before


class Funnel:
    """Counts what becomes of the tracks of a sequence."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.slam = Slam(camera, config, steps=SlamSteps(FunnelTracker, FunnelLocalizer))  # type: ignore[arg-type]
        self.ever_mapped: set[int] = set()
        self.frames_seen: Counter[int] = Counter()

    @property
    def tracker(self) -> FunnelTracker:
        assert isinstance(self.slam.tracker, FunnelTracker)
        return self.slam.tracker

    def process_frame(self, front: FrontEndFrame) -> None:
        self.slam.process_frame(front)
        seen = self.slam.tracks.ids[self.slam.tracks.missed == 0]
        self.frames_seen.update(seen.tolist())
        self.ever_mapped.update(seen[self.slam.map.mapped(seen)[0]].tolist())


def stages(funnel: Funnel) -> dict[str, int]:
    """How many tracks reached each stage; every stage is a part of the one before, from `landmark at the end` on."""
    slam = funnel.slam
    statistics = landmark_statistics(slam.map, slam.camera)
    ids = slam.map.landmarks
    keyframes, parallax = statistics.num_observations[ids] >= 3, statistics.parallax_deg[ids]
    information = landmark_information(slam.map, ids, slam.camera, slam.config.snapshot)
    last = slam.map.T_cam_world[slam.map.keyframe_of(slam.map.last_observation[ids])]
    sure = relative_depth_deviations(information, slam.map.points_world[ids], last) < MAX_DEVIATION
    counts = (
        len(funnel.frames_seen), sum(n >= MIN_FRAMES for n in funnel.frames_seen.values()), len(funnel.ever_mapped), len(ids),
        int(keyframes.sum()), int((keyframes & (parallax > 2)).sum()), int((keyframes & (parallax > 5)).sum()),
        int((keyframes & (parallax > 5) & sure).sum()),
    )  # fmt: skip
    return dict(zip(STAGES, counts, strict=True))


def good_per_keyframe(slam: Slam) -> float:
    """Median number of landmarks with three observations and a deviation below 5 % of the depth that a keyframe observes."""
    ids = np.flatnonzero(~np.isnan(slam.map.points_world[:, 0]) & (slam.map.num_observations >= 3))
    information = landmark_information(slam.map, ids, slam.camera, slam.config.snapshot)
    last = slam.map.T_cam_world[slam.map.keyframe_of(slam.map.last_observation[ids])]
    good = np.zeros(len(slam.map.points_world), np.bool_)
    good[ids] = relative_depth_deviations(information, slam.map.points_world[ids], last) < MAX_DEVIATION
    counts = [
        int((good[slam.map.obs_landmark[rows]] & slam.map.obs_valid[rows]).sum())
        for rows in map(slam.map.observations_of, range(slam.map.num_keyframes))
    ]
    return float(np.median(counts)) if counts else 0.0


def measure(source: Path, frames: int | None, config: Config) -> Funnel:
    """The sequence tracked and mapped, with its account."""
    dataset = open_dataset(source)
    front_end, funnel = FrontEnd(config), Funnel(dataset.camera, config)
    for index in range(min(len(dataset), frames or len(dataset))):
        frame = dataset.read(index)
        if not isinstance(frame, Unreadable):
            funnel.process_frame(front_end.process(frame))
    funnel.slam.finish()
    return funnel


def table(columns: dict[str, Funnel]) -> str:
    """Markdown: a column per sequence."""
    lines = ["| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    reached = {name: stages(funnel) for name, funnel in columns.items()}
    lines += [f"| {stage} | " + " | ".join(f"{reached[name][stage]:,}" for name in columns) + " |" for stage in STAGES]
    good = " | ".join(f"{good_per_keyframe(funnel.slam):,.0f}" for funnel in columns.values())
    lines.append(f"| good (3 keyframes, deviation < 5 %) observed by a keyframe, median | {good} |")
    for reason in REASONS:
        shares = (funnel.tracker.ends[reason] / max(1, sum(funnel.tracker.ends.values())) for funnel in columns.values())
        lines.append(f"| tracks that ended: {reason} | " + " | ".join(f"{100 * share:.1f} %" for share in shares) + " |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", type=Path, nargs="+", metavar="SEQUENCE")
    parser.add_argument("--frames", type=int)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        if options.frames is not None and options.frames < 2:
            raise InputError(f"--frames must be at least 2, not {options.frames}")
        config = load_toml(options.config) if options.config else Config()
        text = table({source.resolve().name: measure(source, options.frames, config) for source in options.sources})
        if options.output:
            write_file(options.output, [text.encode()])
    except Vitamin3dError as error:
        print(f"landmark_funnel: {error}", file=sys.stderr)
        return 2
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
