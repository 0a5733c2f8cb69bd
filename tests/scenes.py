# SPDX-License-Identifier: Apache-2.0
"""Small synthetic scenes whose truth is known."""

import dataclasses
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.geometry.cameras import Camera, PinholeCamera
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.geometry.se3 import exp_se3, log_so3
from vitamin3d.initialization.initialization_history import TrackedView
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Frame, Tracks

DEMO = Path(__file__).parents[1] / "data" / "demo"
SHORT_RUN = ("--max-frames", "45")
"""Options of the benchmark's trials in tests."""
PINHOLE = PinholeCamera(520.0, 510.0, 321.5, 239.0, 640, 480)
EUROC = PinholeCamera(458.654, 457.296, 367.215, 248.375, 752, 480, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))


@dataclass(frozen=True)
class Scene:
    """Cameras, points and what the cameras see of them, exactly."""

    camera: Camera
    T_cam_world: np.ndarray
    points: np.ndarray
    obs_camera: np.ndarray
    obs_point: np.ndarray
    pixels: np.ndarray


def project(camera, T_cam_world, points):
    """Ideal pixels by the homogeneous projection matrix."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ (camera.K @ T_cam_world[:3]).T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def two_views(T_1_0, rng, count=300, sigma_px=0.3):
    """Points before two PINHOLE cameras, and their pixels in both, with noise."""
    points = rng.uniform([-2, -1.5, 3], [2, 1.5, 8], (count, 3))
    pixels_0, pixels_1 = (project(PINHOLE, T, points) + sigma_px * rng.standard_normal((count, 2)) for T in (np.eye(4), T_1_0))
    return points, pixels_0, pixels_1


def direction_error_deg(a, b):
    """Between two vectors."""
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def rotation_error_deg(a, b):
    """Between two poses."""
    return np.degrees(np.linalg.norm(log_so3(a[:3, :3].T @ b[:3, :3])))


def arc_poses(count):
    """Cameras on an arc that look at (0, 0, 6), a third of a unit apart; the first is the world."""
    poses = []
    for k in range(count):
        angle = 0.06 * k
        T_world_cam = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, -angle, 0.01 * k]))
        T_world_cam[:3, 3] = [6.0 * np.sin(angle), 0.05 * k, 6.0 - 6.0 * np.cos(angle)]
        poses.append(np.linalg.inv(T_world_cam))
    return np.array(poses)


def arc_scene(num_cameras, num_points, rng, camera=PINHOLE):
    """Each point is seen by three cameras at least; observations sorted by camera."""
    points = rng.uniform([-2.2, -1.6, 4.0], [2.2, 1.6, 8.0], (num_points, 3))
    poses = arc_poses(num_cameras)
    obs = [(k, p) for k in range(num_cameras) for p in range(num_points) if (p + k) % 3 or k < 3]
    obs_camera, obs_point = (np.array(column, np.int32) for column in zip(*obs, strict=True))
    pixels = np.array([project(camera, poses[c], points[p : p + 1])[0] for c, p in obs])
    return Scene(camera, poses, points, obs_camera, obs_point, pixels)


def orbit(camera, num_points, rng):
    """Twelve cameras around a box of points, two rounds of 180° at other heights, rolled: calibration is well determined."""
    points, poses, obs = rng.uniform(-1.5, 1.5, (num_points, 3)), [], []
    for k in range(12):
        turn = exp_se3(np.array([0, 0, 0, 0, 0.5 * (k % 6) + 0.1 * k, 0])) @ exp_se3(
            np.array([0, 0, 0, 0.4 * (k // 6) - 0.2, 0, 0.5 * (k % 4)])
        )
        turn[:3, 3] = -turn[:3, 2] * (4.5 + 0.4 * (k % 3))
        poses.append(np.linalg.inv(turn))
        pixels = camera.distort(project(camera, poses[k], points))
        obs += [(k, p) for p in np.flatnonzero(camera.is_inside(pixels))]
    obs_camera, obs_point = (np.array(column, np.int32) for column in zip(*obs, strict=True))
    pixels = np.array([project(camera, poses[c], points[p : p + 1])[0] for c, p in obs])
    return Scene(camera, np.array(poses), points, obs_camera, obs_point, pixels)


def with_noise(scene, rng, sigma_px=0.5, outlier_share=0.03):
    """The scene with noisy pixels, some of them far off; and which are (M,) outliers."""
    pixels = scene.pixels + sigma_px * rng.standard_normal(scene.pixels.shape)
    is_outlier = rng.random(len(pixels)) < outlier_share
    pixels[is_outlier] += rng.uniform(20, 60, (is_outlier.sum(), 2)) * rng.choice([-1, 1], (is_outlier.sum(), 2))
    return dataclasses.replace(scene, pixels=pixels), is_outlier


def problem_of(scene, num_fixed=1, poses=None, points=None):
    """The adjustment of all of a scene, the first `num_fixed` cameras fixed."""
    poses, points = scene.T_cam_world if poses is None else poses, scene.points if points is None else points
    order = np.argsort(scene.obs_point, kind="stable")
    starts = np.searchsorted(scene.obs_point[order], np.arange(len(points) + 1))
    rows, ids = np.arange(len(scene.pixels)), np.arange(len(points))
    is_free = np.arange(len(poses)) >= num_fixed
    return BundleProblem(poses, is_free, points, scene.obs_camera, scene.obs_point, scene.pixels, starts, order, ids, rows)


def perturbed(scene, rng, pose=0.02, point=0.05):
    """Poses (all but the first) and points near the truth."""
    poses = [exp_se3(pose * rng.standard_normal(6)) @ T if k else T for k, T in enumerate(scene.T_cam_world)]
    return np.array(poses), scene.points + point * rng.standard_normal(scene.points.shape)


def three_cameras(num_fixed, seed=2):
    """Three cameras, fourteen points (the first seen once), perturbed."""
    rng = np.random.default_rng(seed)
    scene = arc_scene(3, 14, rng)
    keep = (scene.obs_point != 0) | (scene.obs_camera == 1)
    pixels = scene.pixels[keep] + rng.normal(0, 1, (keep.sum(), 2))
    scene = dataclasses.replace(scene, obs_camera=scene.obs_camera[keep], obs_point=scene.obs_point[keep], pixels=pixels)
    poses, points = perturbed(scene, rng, 0.005, 0.02)
    return problem_of(scene, num_fixed, poses, points)


def map_of(scene, with_points=True):
    """The scene as a SparseMap, landmark ids 0..P-1; frame 10 k is keyframe k."""
    sparse_map = SparseMap()
    for k, T in enumerate(scene.T_cam_world):
        mine = scene.obs_camera == k
        count = int(mine.sum())
        colors, patches = np.full((count, 3), k, np.uint8), np.full((count, 81), k, np.uint8)
        sparse_map.add_keyframe(10 * k, 10**9 * k, T, scene.obs_point[mine].astype(np.int64), scene.pixels[mine], colors, patches)
    if with_points:
        sparse_map.points_world[:] = scene.points
    return sparse_map


def view_of(index, ids, pixels=None):
    """A view before there is a map: tracks at pixels, at (index, index) where none are given."""
    n = len(ids)
    pixels = np.full((n, 2), float(index)) if pixels is None else pixels
    tracks = Tracks(np.array(ids), pixels, np.ones(n, np.float32), np.zeros(n, np.int32), np.zeros(n, np.int32))
    image = np.full((480, 640), index % 256, np.uint8)
    return TrackedView(Frame(index, 10**9 * index, image), tracks, pixels, NO_MOTION)


def plane(side=1.0, step=0.01, z=0.0):
    """Points of a grid on a square."""
    x, y = np.meshgrid(np.arange(0, side + 1e-9, step), np.arange(0, side + 1e-9, step))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def room(rng, count=4000):
    """Points on three walls and a box: no symmetry."""
    a = rng.random((count, 2))
    walls = [np.column_stack([4 * a[:, 0], 3 * a[:, 1], 0 * a[:, 0]]), np.column_stack([0 * a[:, 0], 3 * a[:, 0], 2 * a[:, 1]])]
    box = np.array([1.0, 0.8, 0.0]) + np.column_stack([0.7 * a[:, 0], 0.5 * a[:, 1], np.full(count, 0.6)])
    return np.vstack([*walls, box])


def texture(height, width, rng, sigma=3.0):
    """A picture (H, W) uint8 with blobs of a size and of four times that size."""
    fine = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), sigma)
    coarse = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 4 * sigma)
    mixed = fine / fine.std() + coarse / coarse.std()
    return np.clip(128 + 35 * mixed, 0, 255).astype(np.uint8)


def warped(image, A, b):
    """The picture after the motion y = A x + b."""
    size = (image.shape[1], image.shape[0])
    return cv2.warpAffine(image, np.column_stack([A, b]), size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def demo_copy(folder):
    """The demo as a sequence of that name."""
    return Path(shutil.copytree(DEMO, folder, ignore=shutil.ignore_patterns("depth0", "scene.ply")))


class Late:
    """Adjusts at once, and gives the result only where it is waited for."""

    def __init__(self):
        self.result = None

    @property
    def is_busy(self):
        return self.result is not None

    def begin(self, task):
        self.result = task()

    def take(self, wait=False):
        result = self.result if wait else None
        self.result = None if wait else self.result
        return result
