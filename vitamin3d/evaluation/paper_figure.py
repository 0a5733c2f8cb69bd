# SPDX-License-Identifier: Apache-2.0
"""The paper's Fig. 3 of a finished run: tracked extrema, points, mesh and normals from one viewpoint, others' points beside them."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.datasets import Dataset, Unreadable
from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import InputError
from vitamin3d.evaluation.comparison import placed_together, read_other, read_own
from vitamin3d.evaluation.finished_run import read_run
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.normal_map import NormalCaster
from vitamin3d.exporters.rendering import draw, draw_points, reduced, side_by_side, stepped_aside, viewer
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array

TRACK_COLOR, SUPERSAMPLING = (80, 255, 80), 2


@dataclass(frozen=True)
class Viewpoint:
    """From where a run is drawn: a keyframe, and steps aside in median depths of what it sees of the fine mesh."""

    keyframe: int | None = None
    """None: the one in the middle."""
    right: float = 0.0
    up: float = 0.2
    back: float = 0.3
    width: int = 480
    """Of a panel, in pixels."""


def paper_figure(run: Path, others: list[str], dataset: Dataset | None, viewpoint: Viewpoint, with_picture: bool = True) -> Array:
    """A page (H, W, 3) uint8 RGB of panels.

    Args:
        run: folder of a finished run.
        others: clouds of other systems, see `read_other`; those that find no place beside ours are left out.
        dataset: the sequence, for the panel of tracked extrema, which needs `tracks.npz`, too; None: without it.
        with_picture: the extrema are drawn on the picture, else on black.

    Raises:
        InputError: a file of the run is missing, or there is no such keyframe.
    """
    canvas, T_view, timestamp_ns = _view(run, viewpoint)
    camera = viewer(canvas, SUPERSAMPLING * viewpoint.width)
    fine, coarse = (NormalCaster(read_ply(run / f"mesh_{name}.ply")) for name in ("high", "low"))
    cloud = read_geometry(run / "cloud.ply")
    drawn = {"points": draw_points(cloud.points, cloud.colors, camera, T_view, 1.5 * SUPERSAMPLING)}
    own, theirs = read_own(run), [read_other(spec) for spec in others]
    for placed in placed_together(own, theirs, None, None)[len(own) :]:
        if placed.placement.how != "none":
            drawn[placed.item.name] = draw_points(placed.geometry.points, None, camera, T_view, 1.5 * SUPERSAMPLING)
    drawn["mesh"] = draw(fine, camera, T_view, "color")
    drawn["normals, fine voxels"] = draw(fine, camera, T_view, "normals")
    drawn["normals, coarse voxels"] = draw(coarse, camera, T_view, "normals")
    panels = {name: reduced(picture, SUPERSAMPLING) for name, picture in drawn.items()}
    if dataset is not None:
        height, width = panels["mesh"].shape[:2]
        panels = {"tracked extrema": tracked_extrema(run, dataset, timestamp_ns, (width, height), with_picture), **panels}
    return side_by_side(list(panels.values()), list(panels), columns=3 if len(panels) <= 6 else 4)


def _view(run: Path, viewpoint: Viewpoint) -> tuple[Camera, Array, int]:
    """The canvas, T_view_world and the keyframe's time."""
    keyframes, canvas = read_tum(run / "keyframes.tum"), read_calibration(run / "depth" / "canvas.yaml").camera
    k = len(keyframes) // 2 if viewpoint.keyframe is None else viewpoint.keyframe
    if not 0 <= k < len(keyframes):
        raise InputError(f"{run}: has the keyframes 0 to {len(keyframes) - 1}, not {k}")
    T_cam_world = inverse(keyframes.T_world_cam[k])
    depth = NormalCaster(read_ply(run / "mesh_high.ply")).median_depth(canvas, T_cam_world)
    T_view = stepped_aside(T_cam_world, depth, viewpoint.right * depth, viewpoint.up * depth, viewpoint.back * depth)
    return canvas, T_view, int(keyframes.timestamps_ns[k])


def tracked_extrema(run: Path, dataset: Dataset, timestamp_ns: int, size: tuple[int, int], with_picture: bool = True) -> Array:
    """The extrema tracked in the frame nearest in time, as dots on its picture or on black; (H, W, 3) of `size` (width, height).

    The picture keeps its shape, white around it.

    Raises:
        InputError: the run has no tracks, or the picture cannot be read.
    """
    tracks, index = read_run(run).tracks, int(np.argmin(np.abs(dataset.timestamps_ns - timestamp_ns)))
    frame = dataset.read(index)
    if tracks is None:
        raise InputError(f"{run}: no tracks.npz; reconstruct with --save-tracks")
    if isinstance(frame, Unreadable):
        raise InputError(f"{frame.path}: {frame.reason}")
    picture = cv2.cvtColor(frame.image, cv2.COLOR_GRAY2RGB) if frame.color is None else frame.color
    picture = np.ascontiguousarray(picture if with_picture else np.zeros_like(picture))
    scale = max(1, round(SUPERSAMPLING * size[0] / picture.shape[1]))
    large = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    for u, v in (tracks[2][tracks[0] == index] + 0.5) * scale - 0.5:
        cv2.circle(large, (round(float(u)), round(float(v))), scale, TRACK_COLOR, -1, cv2.LINE_AA)
    return _within(large, size)


def _within(picture: Array, size: tuple[int, int]) -> Array:
    """The picture scaled into the middle of a white one of `size` (width, height)."""
    factor = min(size[0] / picture.shape[1], size[1] / picture.shape[0])
    small = cv2.resize(picture, (round(factor * picture.shape[1]), round(factor * picture.shape[0])), interpolation=cv2.INTER_AREA)
    page = np.full((size[1], size[0], 3), 255, np.uint8)
    top, left = (size[1] - small.shape[0]) // 2, (size[0] - small.shape[1]) // 2
    page[top : top + small.shape[0], left : left + small.shape[1]] = small
    return page
