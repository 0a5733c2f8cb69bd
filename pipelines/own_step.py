# SPDX-License-Identifier: Apache-2.0
"""A step of your own: OpenCV's KLT follows the extrema instead of dense flow and hill climbing; all else stays as it is.

    python pipelines/own_step.py data/demo

Whatever has the methods of a protocol in `vitamin3d/steps.py` can take a step's place; here a class that inherits most of them.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from vitamin3d import Atlas, Config, FrontEnd, SlamSteps, Tracker, Unreadable, open_dataset
from vitamin3d.types import Array, FrontEndFrame, TrackedView, Tracks

SETTINGS = {"winSize": (15, 15), "maxLevel": 3, "minEigThreshold": 1e-3}


class KltTracker(Tracker):
    """Tracks born at extrema of curvature, followed by Lucas and Kanade's method from the picture before."""

    _before: Array | None = None
    """The picture that the newest one continues."""
    _pictures: dict[int, Array]
    """Of the newest frames, one of which the next picture may continue."""

    def follow(self, front: FrontEndFrame, measures_motion: bool) -> tuple[int, Array] | None:
        """As of `Tracker`; the picture is kept for the next one."""
        self._pictures = getattr(self, "_pictures", {})
        self._before = self._pictures.get(-1 if front.follows is None else front.follows)
        result = super().follow(front, measures_motion)
        self._pictures[front.frame.index] = front.frame.image
        self._pictures.pop(front.frame.index - self.config.continuity.max_gap - 1, None)
        return result

    def continue_from(self, views: Sequence[TrackedView]) -> None:
        """With the pictures of the map in which the camera was lost."""
        super().continue_from(views)
        self._pictures = {view.frame.index: view.frame.image for view in views}

    def climb(self, predicted: Array, front: FrontEndFrame) -> Tracks:
        """The tracks (N) that KLT finds, from where dense flow predicts them (N, 2), in both directions."""
        if self._before is None or not len(self.tracks):
            return Tracks.empty()
        start, guess, image = np.float32(self.tracks.pixels), np.float32(predicted), front.frame.image
        flag = cv2.OPTFLOW_USE_INITIAL_FLOW
        found, is_found, _ = cv2.calcOpticalFlowPyrLK(self._before, image, start, guess, flags=flag, **SETTINGS)  # type: ignore[call-overload]
        back, is_back, _ = cv2.calcOpticalFlowPyrLK(image, self._before, found, start.copy(), flags=flag, **SETTINGS)  # type: ignore[call-overload]
        agrees = (is_found & is_back).ravel().astype(bool) & (np.linalg.norm(back - start, axis=1) < 0.5)
        height, width = image.shape
        agrees &= ((found > 2) & (found < [width - 3, height - 3])).all(axis=1)
        moved = Tracks(self.tracks.ids, found.astype(np.float64), self.tracks.kappa, self.tracks.ages + 1, self.tracks.missed)
        return moved.select(agrees)


def main(arguments: list[str]) -> int:
    """Tracks a sequence both ways and says how far each came."""
    if len(arguments) != 1:
        print(__doc__)
        return 2
    dataset, config = open_dataset(Path(arguments[0])), Config()
    for name, steps in (("hill climbing", SlamSteps()), ("KLT", SlamSteps(tracker=KltTracker))):
        front_end, atlas = FrontEnd(config), Atlas(dataset.camera, config, steps)
        for index in range(len(dataset)):
            frame = dataset.read(index)
            if not isinstance(frame, Unreadable):
                atlas.process_frame(front_end.process(frame))
        atlas.finish()
        maps = atlas.ranked()  # the largest first
        frames, landmarks = sum(len(slam.trajectory()) for slam in maps), sum(len(slam.map.landmarks) for slam in maps)
        print(f"{name}: {frames} of {len(dataset)} frames localised, maps: {len(maps)}, landmarks: {landmarks}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
