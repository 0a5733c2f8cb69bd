# SPDX-License-Identifier: Apache-2.0
"""What is asked of a camera model, whatever its parameters are.

A pixel is *distorted* (of the picture as it was taken) or *ideal*: of the pinhole camera without distortion that the map is kept in. All
but self-calibration, readers and writers know a camera by these methods only.
"""

from collections.abc import Mapping
from typing import Protocol

from vitamin3d.types import Array


class Camera(Protocol):
    """A calibrated camera that does not change; `PinholeCamera` is one."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    @property
    def readout_s(self) -> float:
        """Seconds from the first to the last row of a rolling shutter; 0: all at once."""

    @property
    def intrinsics(self) -> Array:
        """(4,) focal lengths and centre of the ideal pixels, for the kernels."""

    @property
    def K(self) -> Array:
        """(3, 3) the same as a matrix."""

    @property
    def model(self) -> Array:
        """(8,) all parameters, for the kernels of bundle adjustment."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """The same by their names, for self-calibration and files."""

    @property
    def half_field(self) -> tuple[float, float]:
        """Tangents of half the angles of view, right and down."""

    def radians(self, pixels: float) -> float:
        """The angle that so many pixels make up in the middle of the picture."""

    def with_model(self, model: Array) -> "Camera":
        """The same camera with other parameters (8,)."""

    def with_readout(self, readout_s: float) -> "Camera":
        """The same camera with another readout time."""

    def project(self, points_cam: Array) -> Array:
        """Distorted pixels (N, 2) of points (N, 3) in the camera frame; NaN behind the camera."""

    def unproject(self, pixels: Array) -> Array:
        """Rays (N, 3) with z = 1 of distorted pixels (N, 2); NaN where the model cannot be inverted."""

    def ideal_from_points(self, points_cam: Array) -> Array:
        """Ideal pixels (N, 2) of points (N, 3) in the camera frame; NaN behind the camera."""

    def rays_from_ideal(self, pixels: Array) -> Array:
        """Rays (N, 3) with z = 1 of ideal pixels (N, 2)."""

    def pose_jacobians(self, points_cam: Array) -> tuple[Array, Array]:
        """(N, 6) each: derivatives of the ideal pixels u and v by the tangent [translation, rotation] of the pose."""

    def undistort(self, pixels: Array) -> Array:
        """Ideal pixels (N, 2) of distorted pixels (N, 2); NaN where the model cannot be inverted."""

    def distort(self, pixels: Array) -> Array:
        """Distorted pixels (N, 2) of ideal pixels (N, 2)."""

    def is_inside(self, pixels: Array, margin: float = 0.0) -> Array:
        """(N,) bool: distorted pixels that lie in the picture, `margin` pixels from its border; False for NaN."""

    @property
    def whole_canvas(self) -> "Camera":
        """The undistorted camera of the same focal lengths that holds the whole picture."""

    def canvas(self, limit: float = 0.5) -> "Camera":
        """As `whole_canvas`, at most `limit` times the picture's size wider on each side."""

    def scaled(self, factor: float) -> "Camera":
        """The camera of the same picture with `factor` times as many pixels along each side, without distortion."""

    def cropped(self, width: int, height: int) -> "Camera":
        """The camera of the picture's part from its top left corner on."""

    def ideal_in(self, other: "Camera", pixels: Array) -> Array:
        """Ideal pixels (N, 2) of this camera where another camera at the same place, turned alike, sees the same rays."""

    def canvas_maps(self, canvas: "Camera") -> tuple[Array, Array]:
        """`cv2.remap` maps (H, W) float32 that draw this camera's picture on `canvas`."""

    def draw_on_canvas(self, image: Array, maps: tuple[Array, Array]) -> Array:
        """The picture undistorted onto the canvas of `canvas_maps`; black outside."""
