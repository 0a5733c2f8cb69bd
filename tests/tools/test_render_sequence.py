# SPDX-License-Identifier: Apache-2.0
"""The demo data agree with themselves, and the tool that made them gives the same again."""

import importlib.util
import sys
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from vitamin3d.datasets import Dataset, Unreadable, open_dataset
from vitamin3d.geometry.se3 import inverse, log_so3, transform_points
from vitamin3d.types import Array, Frame, Trajectory

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "data" / "demo"
pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


def the_tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("render_sequence", ROOT / "tools" / "render_sequence.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # numba looks it up when it reads its cache
    spec.loader.exec_module(module)
    return module


def frame(dataset: Dataset, index: int) -> Frame:
    read = dataset.read(index)
    assert not isinstance(read, Unreadable)
    return read


def truth(dataset: Dataset) -> Trajectory:
    trajectory = dataset.ground_truth()
    assert trajectory is not None
    return trajectory


def depth_of(folder: Path, timestamp_ns: int) -> Array:
    return np.asarray(cv2.imread(str(folder / "depth0" / f"{timestamp_ns}.png"), cv2.IMREAD_UNCHANGED)) / 1000.0


@pytest.fixture(scope="module")
def demo() -> Dataset:
    return open_dataset(DEMO)


def test_the_demo_opens(demo: Dataset) -> None:
    assert (demo.name, len(demo)) == ("demo", 150)
    assert frame(demo, 0).color is not None
    np.testing.assert_array_equal(np.diff(demo.timestamps_ns), 50_000_000)
    np.testing.assert_array_equal(truth(demo).timestamps_ns, demo.timestamps_ns)
    assert len(list((DEMO / "depth0").glob("*.png"))) == 15


def test_every_picture_can_be_read(demo: Dataset) -> None:
    assert not [index for index in range(len(demo)) if isinstance(demo.read(index), Unreadable)]


def test_the_camera_moves_smoothly_from_the_start(demo: Dataset) -> None:
    poses = truth(demo).T_world_cam
    speed = 20 * np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = [20 * np.rad2deg(np.linalg.norm(log_so3(a[:3, :3].T @ b[:3, :3]))) for a, b in pairwise(poses)]
    assert speed.min() > 0.35 and speed.max() < 0.65
    assert max(turn) < 25.0


def test_the_pictures_are_rich(demo: Dataset) -> None:
    for index in range(0, len(demo), 30):
        corners = cv2.goodFeaturesToTrack(frame(demo, index).image, 10_000, 0.01, 4)
        assert corners is not None and len(corners) >= 1500


def reprojected(dataset: Dataset, depth: Array, source: int, target: int) -> tuple[Array, Array, Array]:
    """Pixels of a grid in `source`, where they lie in `target` (both distorted), and their depth there."""
    camera, poses = dataset.camera, truth(dataset).T_world_cam
    v, u = (axis.ravel() for axis in np.mgrid[4 : camera.height - 4 : 3, 4 : camera.width - 4 : 3])
    pixels = np.stack([u, v], 1).astype(float)
    points = camera.rays_from_ideal(camera.undistort(pixels)) * depth[v, u, None]
    there = transform_points(inverse(poses[target]) @ poses[source], points)
    return pixels, camera.distort(camera.ideal_from_points(there)), there[:, 2]


def test_poses_depth_and_pictures_agree(demo: Dataset) -> None:
    source, target = 60, 70
    depth, other = (depth_of(DEMO, int(demo.timestamps_ns[i])) for i in (source, target))
    assert depth.shape == (320, 480) and depth.min() > 1.0 and depth.max() < 6.0
    pixels, moved, z = reprojected(demo, depth, source, target)
    inside = demo.camera.is_inside(moved, 2.0)
    pixels, moved, z = pixels[inside], moved[inside], z[inside]
    assert np.median(np.linalg.norm(moved - pixels, axis=1)) > 5.0
    nearest = np.round(moved).astype(int)
    seen = np.abs(other[nearest[:, 1], nearest[:, 0]] - z) < 0.03
    assert seen.mean() > 0.8
    a, b = (frame(demo, i).image.astype(np.float32) for i in (source, target))
    values = cv2.remap(b, moved[seen].astype(np.float32)[:, None], None, cv2.INTER_LINEAR)[:, 0]
    here = pixels[seen].astype(int)
    right = np.abs(values - a[here[:, 1], here[:, 0]])
    wrong = np.abs(b[here[:, 1], here[:, 0]] - a[here[:, 1], here[:, 0]])
    assert np.median(right) < 6.0 < 12.0 < np.median(wrong)


def test_the_surface_is_the_one_of_the_depth(demo: Dataset) -> None:
    tool = the_tool()
    import open3d as o3d

    mesh = o3d.io.read_triangle_mesh(str(DEMO / "scene.ply"))
    caster = tool.ray_caster(np.asarray(mesh.vertices), np.asarray(mesh.triangles))
    T = truth(demo).T_world_cam[0]
    rays = tool.rays_of(demo.camera, 1) @ T[:3, :3].T
    table = np.concatenate([np.broadcast_to(T[:3, 3], rays.shape), rays], 1)[::37].astype(np.float32)
    hits = caster.cast_rays(tool.as_tensor(table))["t_hit"].numpy()
    difference = np.abs(hits - depth_of(DEMO, int(demo.timestamps_ns[0])).ravel()[::37])
    assert np.percentile(difference, 99) < 2e-3


@pytest.mark.slow
def test_the_tool_gives_the_same_twice(tmp_path: Path) -> None:
    tool = the_tool()
    for name in ("a", "b"):
        assert tool.main(["--quick", "--frames", "3", "--size", "48", "32", "--out", str(tmp_path / name)]) == 0
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 8
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path
    assert len(open_dataset(tmp_path / "a")) == 3


def test_the_tool_refuses_nonsense(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        the_tool().main(["--frames", "1000"])
    assert "--frames must be 2 to 150" in capsys.readouterr().err
