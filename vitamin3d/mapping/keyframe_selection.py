# SPDX-License-Identifier: Apache-2.0
"""When a frame becomes a keyframe (the paper does not say)."""

import numpy as np

from vitamin3d.config import KeyframeConfig
from vitamin3d.types import Array


def is_keyframe(pixels_keyframe: Array, pixels_now: Array, num_keyframe_landmarks: int, gap: int, config: KeyframeConfig) -> bool:
    """Whether the picture has moved, or lost its landmarks, enough since the last keyframe.

    Args:
        pixels_keyframe, pixels_now: (N, 2) ideal pixels of the last keyframe's landmarks that are still tracked.
        num_keyframe_landmarks: how many it had.
        gap: frames since the last keyframe.
    """
    if gap < config.min_gap:
        return False
    if len(pixels_now) == 0 or len(pixels_now) < config.min_tracked_ratio * num_keyframe_landmarks:
        return True
    return bool(np.median(np.linalg.norm(pixels_now - pixels_keyframe, axis=1)) >= config.motion_px)
