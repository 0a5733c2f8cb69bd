# SPDX-License-Identifier: Apache-2.0
"""The steps of the sparse half that can be exchanged, and who does them where nobody else is named."""

from collections.abc import Callable
from dataclasses import dataclass

from vitamin3d.bundle_adjustment.adjust import adjust_bundle
from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.localization.localizer import Localizer
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.steps import BundleSolver, CameraLocalizer, LandmarkMapper, LandmarkTracker
from vitamin3d.tracking.tracker import Tracker, TrackIds


@dataclass(frozen=True)
class SlamSteps:
    """What makes each of them; `steps.py` says what they must do."""

    tracker: Callable[[Camera, Config, TrackIds], LandmarkTracker] = Tracker
    localizer: Callable[[LandmarkTracker, LandmarkMapper, PoseLog, Config], CameraLocalizer] = Localizer
    solve: BundleSolver = adjust_bundle
    """Adjusts the windows of keyframes."""
