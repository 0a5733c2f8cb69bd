# SPDX-License-Identifier: Apache-2.0
"""Every object that crosses a module border.

Conventions, here once for the whole project:

* `X_a = T_a_b @ X_b`; the stored pose is `T_cam_world` (what projection needs). Camera: x right, y down, z forward.
* Pixels are `(u, v)`, float; (0, 0) is the centre of the top-left pixel. A pixel is *distorted* (of the picture as it
  was taken: tracks) or *ideal* (of the pinhole camera with the same focal lengths and centre, no distortion: the map).
* Lengths are in map units until a scale is known: a monocular camera has no metre.
* Images are uint8 or float32, geometry is float64. Invalid is NaN.
* Time is an integer number of nanoseconds, so that time stamps come out exactly as they went in.
"""

import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Frame:
    """A picture of the sequence."""

    index: int
    """Position in the sequence as the source numbers it (counts skipped frames)."""
    timestamp_ns: int
    image: Array
    """(H, W) uint8 grey."""
    color: Array | None = None
    """(H, W, 3) uint8 RGB, or None where the source is grey."""

    @property
    def num_bytes(self) -> int:
        """Of memory."""
        return self.image.nbytes + (0 if self.color is None else self.color.nbytes)


@dataclass(frozen=True)
class DominantFlow:
    """Affine motion of the whole image, `y = A x + b` (Eq. 2), in distorted pixels."""

    A: Array
    """(2, 2)."""
    b: Array
    """(2,) pixels."""
    inlier_ratio: float
    """Share of the matches that follow the flow; 0 where matching failed and this is the fallback."""


@dataclass(frozen=True)
class FrontEndFrame:
    """What the front end computes from pixels alone, so that it can run ahead of the map."""

    frame: Frame
    kappa: Array
    """(H, W) float32, curvature of the smoothed image (Eq. 1); grey levels³ per pixel⁴."""
    extrema: Array
    """(E, 2) int32, (u, v) of all local maxima of kappa above the noise floor, strongest first."""
    dominant_flow: DominantFlow
    dense_flow: Array | None
    """(h, w, 2) float32 from the followed to this frame, of and in pixels of the reduced picture; None where there is none."""
    follows: int | None = None
    """Index of the frame whose tracks go on in this one: the previous, an earlier one where pictures between were of something
    else, None where the picture continues none of them."""
    noise: float = 0.0
    """Standard deviation of the noise of this picture and those before it, grey levels; 0 where it is not measured."""
    is_repeat: bool = False
    """The picture is the one before once more, bit by bit: it says nothing about where the camera is by now."""


@dataclass(frozen=True)
class Tracks:
    """The live tracks of one frame; arrays of one length N, sorted by nothing."""

    ids: Array
    """(N,) int64, never used again in a run; the id of a track is the id of its landmark."""
    pixels: Array
    """(N, 2) float64, distorted pixels."""
    kappa: Array
    """(N,) float32, curvature at the extremum when it was last seen."""
    ages: Array
    """(N,) int32, frames since the track was born."""
    missed: Array
    """(N,) int32, frames in a row that it coasted on its prediction; 0 = seen in this frame."""

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: Array | slice) -> "Tracks":
        """The tracks of a mask (N,) bool, of indices, or of a slice."""
        arrays = self.ids, self.pixels, self.kappa, self.ages, self.missed
        if isinstance(keep, slice):
            return Tracks(*(array[keep] for array in arrays))
        rows = np.flatnonzero(keep) if keep.dtype == np.bool_ else keep  # five masks cost more than one and five lists of rows
        return Tracks(*(array.take(rows, axis=0) for array in arrays))

    def renamed(self, old: Array, new: Array) -> "Tracks":
        """The tracks with ids `old` (M,), all of them there, replaced by `new` (M,)."""
        ids, order = self.ids.copy(), np.argsort(self.ids)
        ids[order[np.searchsorted(self.ids, old, sorter=order)]] = new
        return Tracks(ids, self.pixels, self.kappa, self.ages, self.missed)

    @staticmethod
    def empty() -> "Tracks":
        return Tracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.int32))

    @staticmethod
    def concatenate(a: "Tracks", b: "Tracks") -> "Tracks":
        pairs = zip((a.ids, a.pixels, a.kappa, a.ages, a.missed), (b.ids, b.pixels, b.kappa, b.ages, b.missed), strict=True)
        return Tracks(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class TrackedView:
    """A frame with the tracks seen in it."""

    frame: Frame
    tracks: Tracks
    """Without those that coast."""
    ideal_pixels: Array
    """(N, 2) of the tracks."""
    image_motion: Array
    """(6, 2) how the image moved (`geometry/rolling_shutter.py`)."""


def shared_tracks(a: TrackedView, b: TrackedView) -> tuple[Array, Array]:
    """Rows (N,) in a and rows (N,) in b of the tracks that both have."""
    _, rows_a, rows_b = np.intersect1d(a.tracks.ids, b.tracks.ids, assume_unique=True, return_indices=True)
    return rows_a, rows_b


@dataclass(frozen=True)
class TwoView:
    """A first map from two frames: the first camera is the world."""

    T_1_0: Array
    """(4, 4), length of the translation 1."""
    points_0: Array
    """(N, 3), NaN where the point did not pass."""
    parallax_deg: Array
    """(N,)."""
    is_inlier: Array
    """(N,) bool."""


@dataclass(frozen=True)
class Localization:
    """Pose of a frame against the map."""

    T_cam_world: Array
    """(4, 4)."""
    is_inlier: Array
    """(N,) bool, of the correspondences given."""
    rmse_px: float
    """Of the inliers."""
    converged: bool
    """False: the pose must not be used."""


@dataclass(frozen=True)
class BundleReport:
    """What an adjustment did."""

    costs: Array
    """(I + 1,) robust cost before the first and after each sweep, the objective that is minimised."""
    converged: bool
    num_observations: int
    rmse_px: float
    """Root mean square reprojection error of the observations below three sigmas."""
    stopped: str = ""
    """Why: `gain` (a step gained too little), `iterations`, `no descent`."""
    gradient_norms: Array = field(default_factory=lambda: np.zeros(0))
    """(I,) before each step: half the cost's derivative by all free variables."""
    pose_steps: Array = field(default_factory=lambda: np.zeros(0))
    """(I,) largest norm of a camera's tangent [translation, rotation] in each step."""
    point_steps: Array = field(default_factory=lambda: np.zeros(0))
    """(I,) largest distance that a point moved in each step, map units."""


@dataclass(frozen=True)
class MapSnapshot:
    """A keyframe with the depths of its landmarks; the message from the sparse to the dense half."""

    frame: Frame
    T_cam_world: Array
    """(4, 4)."""
    pixels: Array
    """(N, 2) ideal pixels: where the landmarks project."""
    depths: Array
    """(N,) along z, map units."""
    relative_deviations: Array
    """(N,) standard deviation of the depth divided by the depth."""
    map_number: int = 0
    """Of the map it belongs to, in the order of their births."""


@dataclass(frozen=True)
class NewestFrame:
    """How late it is: keyframes may have waited long enough for later ones. Comes between snapshots in live runs."""

    timestamp_ns: int


@dataclass(frozen=True)
class ImageMesh:
    """A triangulation of a keyframe's landmarks in the image."""

    pixels: Array
    """(V, 2) float64 ideal pixels."""
    triangles: Array
    """(F, 3) int32."""
    edges: Array
    """(E, 2) int32, each edge once."""
    inverse_depth: Array
    """(V,) float64, per map unit."""
    relative_deviation: Array
    """(V,) float64, standard deviation of the depth divided by the depth."""


@dataclass(frozen=True)
class DepthView:
    """Depth and normals of a keyframe, rasterised on the canvas camera (the whole undistorted picture)."""

    timestamp_ns: int
    T_cam_world: Array
    """(4, 4)."""
    depth: Array
    """(H, W) float32 along z, map units; 0 = none."""
    normals_cam: Array
    """(H, W, 3) float32 unit vectors in the camera frame, towards the camera; 0 = none."""
    color: Array
    """(H, W, 3) uint8 RGB (grey pictures: three equal channels)."""
    weights: Array
    """(H, W) float32 inverse variance of the depth, per squared map unit; 0 = none."""
    map_number: int = 0
    """Of the map it belongs to, in the order of their births."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh."""

    vertices_world: Array
    """(V, 3) float64."""
    triangles: Array
    """(F, 3) int32."""
    normals_world: Array
    """(V, 3) float64, unit."""
    colors: Array
    """(V, 3) uint8 RGB."""


@dataclass(frozen=True)
class PointCloud:
    """The landmarks of a map that passed the export's filter."""

    points_world: Array
    """(N, 3) float64."""
    colors: Array
    """(N, 3) uint8 RGB."""
    num_observations: Array
    """(N,) int32, in keyframes."""
    parallax_deg: Array
    """(N,) float32, largest angle between two of its rays."""
    reprojection_rms_px: Array
    """(N,) float32."""
    depth_deviation: Array
    """(N,) float32, standard deviation along the ray divided by the depth."""


@dataclass(frozen=True)
class Trajectory:
    """Poses in time."""

    timestamps_ns: Array
    """(T,) int64, ascending."""
    T_world_cam: Array
    """(T, 4, 4), camera to world."""

    def __len__(self) -> int:
        return len(self.timestamps_ns)


class SlamState(Enum):
    """What the tracker is doing after a frame."""

    INITIALIZING = "initializing"
    """There is no map yet."""
    ROTATING = "rotating"
    """No map, but the camera turns without travelling: its orientation is followed."""
    TRACKING = "tracking"
    UNCERTAIN = "uncertain"
    """Tracked, but what is seen does not determine the pose well: nothing is added to the map."""
    LOST = "lost"

    @property
    def is_tracked(self) -> bool:
        """Whether landmarks localise the camera."""
        return self in (SlamState.TRACKING, SlamState.UNCERTAIN)


@dataclass(frozen=True)
class FrameNote:
    """What became of a frame when it was processed, and what it looked like: why it is not localised, where it is not."""

    index: int
    timestamp_ns: int
    state: SlamState
    map_number: int
    """Of the map that it was tracked for, in the order of their births, from 0."""
    num_extrema: int
    num_tracks: int
    """Seen in it."""
    contrast: float
    """Standard deviation of its grey levels."""
    brightness: float
    """Their mean."""
    continues: bool
    """It continues an earlier picture; else it is of something else, or shows nothing."""
    motion_px: float
    """Median motion of the picture since the one it continues; 0 where there is none."""
    reason: str
    """Of a frame without a map: why there is none yet."""


@dataclass
class StepTimes:
    """Milliseconds of each step, by name; grows while a run lasts."""

    milliseconds: dict[str, "array[float]"] = field(default_factory=dict)
    clock: Callable[[], float] = time.perf_counter
    """Seconds; `time.thread_time` measures the thread's own CPU."""

    def add(self, step: str, seconds: float) -> None:
        self.milliseconds.setdefault(step, array("d")).append(1e3 * seconds)

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Adds the time of what is inside."""
        start = self.clock()
        yield
        self.add(step, self.clock() - start)
