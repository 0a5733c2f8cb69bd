# SPDX-License-Identifier: Apache-2.0
"""The steps that can be exchanged: what `Slam` and `Reconstruction` ask of each.

A step of your own is a class with these methods. `SlamSteps(tracker=MyTracker)` gives it to `Atlas` or `Slam`, see `pipelines/own_step.py`;
`Reconstruction(…, mesher=MyMesher(…), make_volume=MyVolume)` to the dense half. A front end of your own only has to make the
`FrontEndFrame`s that `process_frame` takes.
"""

from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar

from vitamin3d.bundle_adjustment.marginalization import CameraPrior
from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.config import BundleAdjustmentConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, BundleReport, DepthView, Frame, FrontEndFrame, MapSnapshot, SlamState, Surface, TrackedView, Tracks


class LandmarkTracker(Protocol):
    """Follows points from frame to frame; `vitamin3d.tracking.tracker.Tracker` follows the extrema of curvature."""

    tracks: Tracks
    """The live ones."""
    first_id: int
    """No track has a lesser id."""
    frame_count: int
    """Frames since the beginning."""
    newest_frame: int
    """Its index; -1 before the first one."""
    num_born: int
    """Tracks since the beginning."""
    image_motion: Array
    """(6, 2) of the newest frame (`geometry/rolling_shutter.py`)."""

    def follow(self, front: FrontEndFrame, measures_motion: bool) -> tuple[int, Array] | None:
        """The tracks in the next frame. Where it measures how the image moves: time stamp and image motion of the frame before."""

    @property
    def is_refill_due(self) -> bool:
        """Whether new tracks are wanted in this frame."""

    def refill(self, front: FrontEndFrame) -> None:
        """New tracks where there are none."""

    def seen(self) -> tuple[Tracks, Array]:
        """The tracks that are seen in the newest frame, and their ideal pixels (N, 2)."""

    def view(self, frame: Frame) -> TrackedView:
        """The newest frame with the tracks seen in it."""

    def take_up(self, tracks: Tracks) -> None:
        """These are the live tracks from now on: landmarks came back into view, or became one."""

    def end(self, ids: Array) -> None:
        """Ends the tracks with these ids (N,): they contradict the map."""

    def end_all(self) -> None:
        """Ends every track."""

    def continue_from(self, views: Sequence[TrackedView]) -> None:
        """Goes on with the tracks of the newest of some frames of another tracker."""

    def end_frame(self, frame: Frame) -> None:
        """The next frame continues this one."""

    def pass_over(self, frame: Frame) -> None:
        """A picture that repeats the one before."""

    def use_camera(self, camera: Camera) -> None:
        """Ideal pixels are those of this camera from now on."""


class CameraLocalizer(Protocol):
    """Finds the camera in a map; `vitamin3d.localization.localizer.Localizer` by P3P, descriptors and the map's landmarks."""

    state: SlamState
    """Of the newest frame."""

    def begin(self, keyframes: list[Frame]) -> None:
        """There is a map now, with these keyframes."""

    def locate(self, front: FrontEndFrame) -> Array | None:
        """T_cam_world (4, 4) of a frame, None where the camera is lost; only where the state is TRACKING the map may grow by it."""

    def refine(self, T_cam_world: Array) -> Array:
        """The pose of the newest frame after the map has moved."""

    def position_deviation_deg(self, T_cam_world: Array) -> float:
        """How well the camera's place is known, as an angle at the median depth."""

    def note_directions(self) -> None:
        """The newest frame has its pose, and is the last one before a turn, for all that is known."""

    def lose(self) -> None:
        """What was found lately is not believed any more."""

    def remember(self, keyframe: int, frame: Frame) -> None:
        """A new keyframe, in which the camera may be found again."""

    def forget(self, kept_keyframes: Array, kept_ids: Array) -> None:
        """The map is smaller now: of its keyframes those with the old numbers (K',) stay, of its tracks those with the ids (I,)."""


class BundleSolver(Protocol):
    """Adjusts the poses and points of a window; `vitamin3d.bundle_adjustment.adjust.adjust_bundle` as the settings say."""

    def __call__(
        self, problem: BundleProblem, camera: Camera, config: BundleAdjustmentConfig, prior: CameraPrior | None = None, /
    ) -> tuple[BundleProblem, BundleReport]: ...


class LandmarkMapper(Protocol):
    """What a localizer asks of the map's owner."""

    map: SparseMap
    camera: Camera

    def recover(self, front: FrontEndFrame, T_cam_world: Array, gate_px: float | None = None) -> int:
        """Takes up landmarks that came back into view; how many."""


class PixelFrontEnd(Protocol):
    """What needs pixels only, ahead of the map; `vitamin3d.tracking.front_end.FrontEnd`."""

    def process(self, frame: Frame) -> FrontEndFrame:
        """Curvature, its extrema, and the flow from the picture that this one continues."""


In = TypeVar("In", contravariant=True)
Out = TypeVar("Out", covariant=True)


class Stage(Protocol[In, Out]):
    """One step of the dense half's chain; what goes in comes out later, or not at all."""

    def push(self, item: In) -> Iterator[Out]:
        """Takes an item, in the order of time; those that are ready."""

    def expire(self, now_ns: int) -> Iterator[Out]:
        """What has waited too long by this time of the recording."""

    def flush(self) -> Iterator[Out]:
        """What still waits: nothing will follow."""

    def clear(self) -> None:
        """Drops what waits."""


Mesher = Stage[MapSnapshot, DepthView]
"""A keyframe with the depths of its landmarks -> depth and normals of its picture; `vitamin3d.dense.stages.Meshing`."""


class Volume(Protocol):
    """What depth views are averaged into; `vitamin3d.dense.tsdf_fusion.TsdfVolume`."""

    voxel_length: float

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        """Averages a view, drawn on `canvas`, in; depths beyond `max_depth` (map units) are left out."""

    def remove(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        """Takes a view out that was integrated just so. InputError: it cannot."""

    def size(self) -> dict[str, int] | None:
        """Blocks in use and bytes of them all; None where it does not know."""

    def extract_surface(self) -> Surface:
        """The surface, without vertex normals (zero)."""
