# SPDX-License-Identifier: Apache-2.0
"""The first map, from two frames: essential matrix, decomposition, triangulation (Sec. 5.1).

A camera that stands still or only turns must not initialise: its points have no parallax, whatever the matrix says.
"""

from dataclasses import dataclass

import numpy as np

from vitamin3d.config import InitializationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.essential import relative_pose
from vitamin3d.geometry.rotation_fit import fit_rotation, turned_by
from vitamin3d.localization.rotation_tracking import unit_rays
from vitamin3d.types import Array, TwoView


@dataclass(frozen=True)
class InitializationAttempt:
    """A first map, or the reason why there is none."""

    view: TwoView | None
    reason: str
    """Empty on success; else a phrase for the user."""
    parallax_deg: float = 0.0
    """Median, where it was measured."""
    is_retry: bool = False
    """There was motion and parallax enough for a map, and none came of it; to wait for parallax is no retry."""


def median_motion(pixels_0: Array, pixels_1: Array) -> float:
    """Median distance in pixels between paired pixels (N, 2); 0 for none."""
    return float(np.median(np.linalg.norm(pixels_1 - pixels_0, axis=1))) if len(pixels_0) else 0.0


def initialize_from_two_views(pixels_0: Array, pixels_1: Array, camera: Camera, config: InitializationConfig) -> InitializationAttempt:
    """Tries to build the first map from paired ideal pixels (N, 2) of two frames.

    Returns:
        An attempt whose view has |translation| = 1 and NaN for the points that did not pass; or the reason.
    """
    motion = median_motion(pixels_0, pixels_1)
    if len(pixels_0) < config.min_tracks:
        return InitializationAttempt(None, f"too few features: {len(pixels_0)} tracks, {config.min_tracks} are needed")
    if motion < config.min_motion_px:
        return InitializationAttempt(None, f"no parallax: the picture moved by {motion:.1f} px, {config.min_motion_px:.0f} px are needed")
    view = relative_pose(pixels_0, pixels_1, camera, config.ransac_threshold_px)
    if view is None:
        return InitializationAttempt(None, "no essential matrix explains the motion", is_retry=True)
    return _judged(view, _left_by_a_turn(view, pixels_0, pixels_1, camera, config), config)


def _left_by_a_turn(view: TwoView, pixels_0: Array, pixels_1: Array, camera: Camera, config: InitializationConfig) -> float:
    """Median angle, degrees, that the best rotation alone leaves between the rays of the two views."""
    rays_0, rays_1 = unit_rays(pixels_0, camera), unit_rays(pixels_1, camera)
    R = fit_rotation(rays_0, rays_1, view.T_1_0[:3, :3], camera.radians(config.ransac_threshold_px))
    return float(np.degrees(np.median(turned_by(rays_0, rays_1, R))))


def _judged(view: TwoView, turn_leaves_deg: float, config: InitializationConfig) -> InitializationAttempt:
    """The attempt with the two views, if they may become a map; else why not."""
    inlier_ratio = float(view.is_inlier.mean())
    good = np.isfinite(view.points_0[:, 0])
    if inlier_ratio < config.min_inlier_ratio:
        reason = f"the motion is not that of a rigid scene: only {100 * inlier_ratio:.0f} % of the tracks agree"
        return InitializationAttempt(None, reason, is_retry=True)
    parallax = float(np.median(view.parallax_deg[view.is_inlier]))
    if parallax < config.min_parallax_deg:
        return InitializationAttempt(None, f"no parallax: {parallax:.2f}° in the median, the camera turns but does not travel", parallax)
    if turn_leaves_deg < config.turn_deg and parallax > config.max_parallax_ratio * turn_leaves_deg:
        return InitializationAttempt(None, f"no parallax: a turn explains {parallax:.2f}° as well, the camera turns but does not travel")
    if good.sum() < max(config.min_tracks, config.min_triangulated_ratio * view.is_inlier.sum()):
        reason = f"only {int(good.sum())} of {int(view.is_inlier.sum())} tracks lie in front of both cameras"
        return InitializationAttempt(None, reason, parallax, is_retry=True)
    return InitializationAttempt(view, "", parallax)
