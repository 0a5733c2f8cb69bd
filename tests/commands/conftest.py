# SPDX-License-Identifier: Apache-2.0
"""A made-up run of the demo: its true mesh, in another world and unit; and what another system left of it."""

import json

import numpy as np
import pytest
import scenes

from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.exporters.mesh import write_ply
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.geometry.se3 import exp_so3
from vitamin3d.types import Surface, Trajectory

DEMO = scenes.DEMO


def moved(trajectory, points, scale, R, t):
    """A trajectory and points in another world."""
    poses = np.array(trajectory.T_world_cam)
    poses[:, :3, :3] = R @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ R.T + t
    return Trajectory(trajectory.timestamps_ns, poses), scale * points @ R.T + t


@pytest.fixture(scope="session")
def seen(demo):
    """Points of the true surface that the demo's depth maps saw, thinned."""
    from vitamin3d.evaluation.reference_surface import cloud_of_depth

    return cloud_of_depth(DEMO, demo, demo.ground_truth())


@pytest.fixture
def run(demo, seen, tmp_path):
    """A finished run: half the unit, turned; its mesh is the scene itself, its cloud a third of what was seen."""
    folder = tmp_path / "run"
    (folder / "depth").mkdir(parents=True)
    scene, R, t = read_geometry(DEMO / "scene.ply"), exp_so3(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, 3.0])
    trajectory, vertices = moved(demo.ground_truth(), scene.points, 0.5, R, t)
    colors = np.full((len(vertices), 3), 128, np.uint8)
    write_ply(
        Surface(vertices, scene.triangles.astype(np.int32), np.tile([0.0, 0, 1], (len(vertices), 1)), colors), folder / "mesh_high.ply", []
    )
    np.savetxt(folder / "cloud.xyz", moved(demo.ground_truth(), seen[::3], 0.5, R, t)[1])
    (folder / "cloud.ply").write_bytes(as_ply(moved(demo.ground_truth(), seen[::3], 0.5, R, t)[1]))
    write_tum(trajectory, folder / "trajectory.tum")
    write_tum(Trajectory(trajectory.timestamps_ns[::10], trajectory.T_world_cam[::10]), folder / "keyframes.tum")
    stats = {"frames": 150, "initialization_retries": 0, "scale": {"known": False, "source": ""}, "source": "demo"}
    (folder / "stats.json").write_text(json.dumps(stats))
    camera = demo.camera.canvas()
    (folder / "depth" / "canvas.yaml").write_text(
        f"camera_model: pinhole\nintrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\ndistortion_model: radial-tangential\n"
        f"distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\nresolution: [{camera.width}, {camera.height}]\n"
    )
    return folder


def as_ply(points):
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    return head.encode() + points.astype("<f4").tobytes()


@pytest.fixture
def other(demo, seen, tmp_path):
    """What another system left: a trajectory, and a tenth of the points, 1 cm off per axis, in a world of its own."""
    folder = tmp_path / "orbslam3" / "demo"
    folder.mkdir(parents=True)
    trajectory, points = moved(
        demo.ground_truth(),
        seen[::10] + 0.01 * np.random.default_rng(2).standard_normal(seen[::10].shape),
        3.0,
        exp_so3(np.array([1.0, 0.5, 0.1])),
        np.array([9.0, 8, 7]),
    )
    write_tum(trajectory, folder / "KeyFrameTrajectory.txt")
    np.savetxt(folder / "MapPoints.txt", points)
    return folder
