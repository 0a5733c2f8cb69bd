# SPDX-License-Identifier: Apache-2.0
"""The true surface as points: from a sequence's depth maps and true poses, or from a scanner's cloud or a mesh."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.datasets import Dataset
from vitamin3d.datasets.image_folder import natural_key
from vitamin3d.datasets.point_files import Geometry
from vitamin3d.datasets.tables import nanoseconds_from_seconds, rows_of
from vitamin3d.errors import InputError
from vitamin3d.evaluation.surface_error import sample_surface
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse, transform_points
from vitamin3d.scale import MATCH_TOLERANCE_NS, match_timestamps
from vitamin3d.types import Array, Trajectory

VOXEL, NEAR, FAR, STRIDE = 0.02, 0.1, 6.0, 2
"""Metres: side of the voxels to which the truth is thinned, and the range of depth that is used; every so many-th pixel."""
TUM_COUNTS, MILLIMETRES, NO_DEPTH = 5000.0, 1000.0, 65535
BLOCKED = 0.05
"""A point this share behind the nearest one of its pixel is hidden."""
BLOCK_PX = 8
"""Side of the pixels of the visibility test: scanner points are sparser than pictures."""
MAX_VIEWS = 60
"""Keyframes, spread evenly, that prune a reference."""


@dataclass(frozen=True)
class DepthMap:
    """A depth picture and its unit."""

    timestamp_ns: int
    path: Path
    counts_per_metre: float


def depth_maps(folder: Path, dataset: Dataset) -> list[DepthMap]:
    """The depth maps of a sequence by time: `depth0/<ns>.png` or 7-Scenes' in millimetres, TUM's or ICL-NUIM's in 1/5000 m."""
    if (folder / "depth0").is_dir():
        paths = sorted((folder / "depth0").glob("*.png"))
        return [DepthMap(int(path.stem), path, MILLIMETRES) for path in paths if path.stem.isdigit()]
    if (folder / "depth.txt").is_file():
        rows = rows_of(folder / "depth.txt", "timestamp filename")
        return [DepthMap(nanoseconds_from_seconds(row.fields[0]), folder / row.fields[1], TUM_COUNTS) for row in rows]
    of_frames = sorted(folder.glob("frame-*.depth.png"))
    counts = MILLIMETRES if of_frames else TUM_COUNTS
    paths = of_frames or sorted((folder / "depth").glob("*.png"), key=lambda path: natural_key(path.name))
    if len(paths) != len(dataset):
        return []
    return [DepthMap(int(t), path, counts) for t, path in zip(dataset.timestamps_ns, paths, strict=True)]


def read_depth(depth: DepthMap, camera: Camera) -> Array:
    """Depth (H, W) in metres along z; 0 = none. InputError where the file is no depth map of this camera."""
    counts = cv2.imdecode(np.frombuffer(depth.path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED) if depth.path.is_file() else None
    if counts is None or counts.dtype != np.uint16 or counts.shape != (camera.height, camera.width):
        raise InputError(f"{depth.path}: not a 16-bit depth map of {camera.width}×{camera.height} pixels")
    return np.where(counts == NO_DEPTH, 0.0, counts / depth.counts_per_metre)


def cloud_of_depth(folder: Path, dataset: Dataset, truth: Trajectory, times_ns: Array | None = None) -> Array | None:
    """Points (M, 3) of all depth maps with a true pose, thinned; None where the sequence has none.

    Args:
        truth: of the camera, in metres.
        times_ns: only the depth maps of these moments (keyframes), as MASt3R-SLAM does; None: all.
    """
    maps = depth_maps(folder, dataset)
    rows, poses = match_timestamps(np.array([m.timestamp_ns for m in maps], np.int64), truth.timestamps_ns)
    if times_ns is not None and len(rows):
        near, _ = match_timestamps(np.array([maps[r].timestamp_ns for r in rows]), np.sort(times_ns), MATCH_TOLERANCE_NS)
        rows, poses = rows[near], poses[near]
    return _together([maps[r] for r in rows], truth.T_world_cam[poses], dataset.camera) if len(rows) else None


def _together(maps: list[DepthMap], T_world_cam: Array, camera: Camera) -> Array:
    """`thinned` of the points of all maps, two of which need not be in memory at a time; InputError where there are none."""
    lowest = [points.min(axis=0) for points in _back_projected(maps, T_world_cam, camera) if len(points)]
    if not lowest:
        raise InputError(f"{maps[0].path.parent}: no depth between {NEAR:g} and {FAR:g} m in any map; is its unit another?")
    corner = np.min(lowest, axis=0)
    sums = [_voxel_sums(points, corner, VOXEL) for points in _back_projected(maps, T_world_cam, camera)]
    return _means(*_summed(*(np.concatenate(parts) for parts in zip(*sums, strict=True))))


def _back_projected(maps: list[DepthMap], T_world_cam: Array, camera: Camera) -> Iterator[Array]:
    """Points of each depth map in the world; the maps lie on the distorted grid of the pictures."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(0, camera.width, STRIDE), np.arange(0, camera.height, STRIDE)))
    rays = camera.rays_from_ideal(camera.undistort(np.stack([u, v], axis=1).astype(np.float64)))
    for depth, T in zip(maps, T_world_cam, strict=True):
        z = read_depth(depth, camera)[v, u]
        good = (z > NEAR) & (z < FAR) & np.isfinite(rays[:, 0])
        yield transform_points(T, rays[good] * z[good, None])


def reference_points(scan: Geometry) -> Array:
    """Points (M, 3) of a scanner's cloud or of a mesh, thinned; metres."""
    return thinned(sample_surface(scan, 2_000_000), VOXEL)


def thinned(points: Array, voxel: float) -> Array:
    """The mean of the points of each voxel; the lowest coordinates lie in the middle of theirs, as Open3D has it."""
    return _means(*_voxel_sums(points, points.min(axis=0), voxel)) if len(points) else points


def _voxel_sums(points: Array, lowest: Array, voxel: float) -> tuple[Array, Array]:
    """Keys (V,) of the voxels, and the sum and number (V, 4) of their points."""
    return _summed(voxel_keys(points - lowest + voxel / 2, voxel), np.column_stack([points, np.ones(len(points))]))


def _summed(keys: Array, rows: Array) -> tuple[Array, Array]:
    """Each key once, and the sum of its rows."""
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=keys[order][:1] - 1))
    return keys[order][first], np.add.reduceat(rows[order], first, axis=0) if len(first) else rows


def _means(_: Array, sums: Array) -> Array:
    return np.asarray(sums[:, :3] / sums[:, 3:])


def voxel_keys(points: Array, voxel: float) -> Array:
    """One integer (N,) per point that names its voxel; unique within 2 million voxels each way."""
    cells = np.floor(points / voxel).astype(np.int64) + 2**20
    return np.asarray((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2])


def observed_by(points: Array, T_world_cam: Array, camera: Camera, far: float = FAR) -> Array:
    """(M,) bool: which points of a reference at least one of the cameras sees: in its picture, not too far, and not hidden.

    Args:
        points: (M, 3) in the world.
        T_world_cam: (K, 4, 4) poses of the keyframes.
    """
    seen = np.zeros(len(points), bool)
    chosen = np.unique(np.linspace(0, len(T_world_cam) - 1, min(MAX_VIEWS, len(T_world_cam))).astype(int))
    for T in T_world_cam[chosen]:
        cam = transform_points(inverse(T), points)
        pixels = camera.distort(np.where(cam[:, 2:] > NEAR, camera.ideal_from_points(cam), -1e4))
        inside = (cam[:, 2] > NEAR) & (cam[:, 2] < far) & camera.is_inside(np.nan_to_num(pixels, nan=-1e4)) & _within_lens(cam, camera)
        rows = np.flatnonzero(inside)
        u, v = (pixels[rows] / BLOCK_PX).astype(int).T
        nearest = np.full((camera.height // BLOCK_PX + 1, camera.width // BLOCK_PX + 1), np.inf)
        np.minimum.at(nearest, (v, u), cam[rows, 2])
        seen[rows[cam[rows, 2] <= nearest[v, u] * (1 + BLOCKED) + VOXEL]] = True
    return seen


def _within_lens(cam: Array, camera: Camera) -> Array:
    """(M,) bool: nearer to the axis than the picture's corners; beyond, a distortion model folds back."""
    corners = np.array([[0, 0], [camera.width - 1, 0], [0, camera.height - 1], [camera.width - 1, camera.height - 1]], np.float64)
    widest = np.nanmax(np.linalg.norm(camera.rays_from_ideal(camera.undistort(corners))[:, :2], axis=1)) * 1.05
    return np.asarray(np.linalg.norm(cam[:, :2], axis=1) <= widest * np.maximum(cam[:, 2], 1e-9))
