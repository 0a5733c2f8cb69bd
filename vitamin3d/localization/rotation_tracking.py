# SPDX-License-Identifier: Apache-2.0
"""A camera that turns without travelling, followed by what has no depth: no landmark comes from it, and no length.

A track is known by its direction in the world, taken when it was first seen; the directions of a frame's tracks determine its rotation.
Where the camera travels they show parallax, disagree, and nothing is claimed.
"""

from dataclasses import dataclass, replace

import numpy as np

from vitamin3d.config import RotationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.rotation_fit import fit_rotation, turned_by
from vitamin3d.geometry.se3 import rotation_angle_deg
from vitamin3d.growing_array import GrowingArray, IdRows
from vitamin3d.types import Array, Frame

INLIER_SIGMAS = 3.0


class Directions:
    """By track id: the direction in the world in which a track was first seen; NaN where it is not known."""

    def __init__(self, first_id: int = 0) -> None:
        self._rows, self._directions = IdRows(first_id), GrowingArray((3,), np.float64, np.nan)

    def note(self, ids: Array, pixels: Array, R_cam_world: Array, camera: Camera) -> None:
        """Tracks (N,) ids at ideal pixels (N, 2) that have no direction get the one in which this camera sees them."""
        rows = self._rows.of(ids)
        self._directions.resize(int(rows.max(initial=-1)) + 1)
        new = (rows >= 0) & np.isnan(self._directions.view[rows, 0])
        self._directions.view[rows[new]] = unit_rays(pixels[new], camera) @ R_cam_world

    def of(self, ids: Array) -> Array:
        """Unit directions (N, 3) in the world of tracks (N,) ids."""
        rows = self._rows.of(ids)
        out, known = np.full((len(ids), 3), np.nan), (rows >= 0) & (rows < self._directions.size)
        out[known] = self._directions.view[rows[known]]
        return out

    def keep(self, ids: Array) -> None:
        """Forgets all tracks but those with `ids` (N,), ascending."""
        directions, self._rows = self.of(ids), self._rows.keeping(ids)
        self._directions = GrowingArray((3,), np.float64, np.nan)
        self._directions.append(directions)


class Turns:
    """A chain of frames in which the camera did no more than turn, with their rotations from the first."""

    def __init__(self) -> None:
        self._frames: list[tuple[Frame, Array]] = []
        self._is_ended, self._newest, self._num_doubts = False, np.eye(3), 0

    def judge(self, parallax_deg: float, reference: int, config: RotationConfig) -> None:
        """Ends the chain at the reference of tries to initialise (a frame's index) that show parallax several times in a row."""
        self._num_doubts = self._num_doubts + 1 if parallax_deg > config.max_parallax_deg else 0
        if self._num_doubts >= config.max_doubts:
            self._frames, self._is_ended = [pair for pair in self._frames if pair[0].index <= reference], True

    def ended_before(self, reference: int) -> bool:
        """Whether the chain has ended at a frame from which no map will begin any more."""
        return self._is_ended and (not self._frames or self._frames[-1][0].index < reference)

    @property
    def newest(self) -> Array:
        """R_cam_world (3, 3) of the newest frame, the world being the first's; the identity where there is none."""
        return self._newest

    def add(self, frame: Frame, R_cam_world: Array) -> None:
        self._newest = R_cam_world
        if not self._is_ended:
            self._frames.append((replace(frame, image=frame.image[:0].copy(), color=None), R_cam_world))

    def has_turned(self, config: RotationConfig) -> bool:
        """Whether the camera has turned by more than a hand's shake, in more than a few frames."""
        return not self._is_ended and rotation_angle_deg(self.newest) > config.min_turn_deg

    def since(self, reference: int) -> list[tuple[Frame, Array]]:
        """The frames of the chain with T_cam_reference (4, 4), all at one place; none where the reference frame is not in it."""
        R_reference = next((R for frame, R in self._frames if frame.index == reference), None)
        if R_reference is None:
            return []
        poses = np.tile(np.eye(4), (len(self._frames), 1, 1))
        poses[:, :3, :3] = np.stack([R @ R_reference.T for _, R in self._frames])
        return [(frame, T) for (frame, _), T in zip(self._frames, poses, strict=True)]


def unit_rays(pixels: Array, camera: Camera) -> Array:
    """Unit directions (N, 3) in the camera of ideal pixels (N, 2)."""
    rays = camera.rays_from_ideal(pixels)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@dataclass(frozen=True)
class Turn:
    """A rotation between frames."""

    R_cam_world: Array
    """(3, 3)."""
    is_doubtful: bool
    """Older tracks agree with it less often: the camera may be travelling."""
    share: float
    """Of the tracks, that agree with it."""


def rotation_of(directions: Array, pixels: Array, ages: Array, R_before: Array, camera: Camera, config: RotationConfig) -> Turn | None:
    """R_cam_world (3, 3) that turns directions (N, 3) in the world to ideal pixels (N, 2); None where too few agree on one.

    The older half of the tracks, by their ages (N,), shows parallax first.
    """
    known = np.isfinite(directions[:, 0])
    directions, rays, ages = directions[known], unit_rays(pixels[known], camera), ages[known]
    if len(rays) < config.min_tracks or not config.enabled:
        return None
    sigma = max(camera.radians(config.sigma_px), np.radians(config.sigma_deg))
    R = fit_rotation(directions, rays, R_before, sigma)
    agrees = turned_by(directions, rays, R) < INLIER_SIGMAS * sigma
    is_old = ages >= np.median(ages)
    enough = agrees.sum() >= config.min_tracks and agrees.mean() >= config.min_share
    share = float(agrees.mean())
    return Turn(R, bool(agrees[is_old].mean() < config.min_old_share * share), share) if enough else None
