# SPDX-License-Identifier: Apache-2.0
import numpy as np

from vitamin3d.config import KeyframeConfig
from vitamin3d.mapping.keyframe_selection import is_keyframe


def test_a_frame_becomes_a_keyframe_by_motion_or_by_loss():
    config, still = KeyframeConfig(motion_px=12.0, min_tracked_ratio=0.6, min_gap=2), np.zeros((100, 2))
    assert not is_keyframe(still, still + np.array([8.0, 8.0]), 100, 5, config)
    assert is_keyframe(still, still + np.array([8.0, 9.0]), 100, 5, config)
    assert not is_keyframe(still[:60], still[:60], 100, 5, config)
    assert is_keyframe(still[:59], still[:59], 100, 5, config)
    assert is_keyframe(still[:0], still[:0], 100, 5, config)
    assert not is_keyframe(still[:0], still[:0], 100, 1, config)


def test_a_keyframe_without_landmarks_asks_for_the_next():
    none = np.zeros((0, 2))
    assert is_keyframe(none, none, 0, 1, KeyframeConfig())
