# SPDX-License-Identifier: Apache-2.0
"""From one map to the next: what the map that follows begins with, and what the one that is left keeps."""

import numpy as np

from vitamin3d.geometry.cameras import Camera
from vitamin3d.slam import Slam
from vitamin3d.tracking.tracker import with_ideal_pixels
from vitamin3d.types import SlamState, TrackedView


def succeed(slam: Slam, lost: Slam) -> SlamState:
    """A new map goes on with the newest frames and the tracks of one in which the camera was lost; at once, if these make a map."""
    views = [_seen_by(slam.camera, view) for view in lost.heritage.views]
    slam.tracker.continue_from(views)
    slam.begin(slam.initializer.try_views(views, slam.camera))
    return slam.state


def _seen_by(camera: Camera, view: TrackedView) -> TrackedView:
    """The view with the ideal pixels of a camera that may be another one than when it was tracked: that was refined since."""
    return TrackedView(view.frame, *with_ideal_pixels(view.tracks, view.image_motion, camera), view.image_motion)


def leave(slam: Slam, successor: Slam) -> bool:
    """What the map that followed knows too is its own: before the camera was lost in this one it hung on little, there nothing was lost.

    All since the successor's first frame is, frames of a turn that no landmark ended among them; and what came after the last sound
    keyframe here is nobody's. Whether anything is left.
    """
    slam.heritage.views.clear()
    first = successor.poses.first_frame
    keyframe = min(int(np.searchsorted(slam.map.frame_indices, first)) - 1, slam.mapper.last_sound_keyframe())
    if keyframe < 0:
        return False
    slam.poses.forget_since(first)
    slam.cut_back(keyframe)
    return True
