# SPDX-License-Identifier: Apache-2.0
"""7-Scenes, ICL-NUIM and KITTI as their authors lay them out: pictures, times, cameras, truths."""

import cv2
import numpy as np
import pytest

from vitamin3d.datasets import kind_of, open_dataset
from vitamin3d.errors import InputError
from vitamin3d.evaluation.reference_surface import cloud_of_depth, depth_maps
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.types import Trajectory


@pytest.fixture
def poses(rng):
    return np.array([exp_se3(0.1 * rng.standard_normal(6)) for _ in range(4)])


def write_picture(path, value=80):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((480, 640), value, np.uint8))


def write_depth(path, counts):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((480, 640), counts, np.uint16))


def test_seven_scenes(tmp_path, poses):
    for k, pose in enumerate(poses):
        write_picture(tmp_path / "chess" / "seq-01" / f"frame-{k:06d}.color.png")
        write_depth(tmp_path / "chess" / "seq-01" / f"frame-{k:06d}.depth.png", 2000 if k else 65535)
        np.savetxt(tmp_path / "chess" / "seq-01" / f"frame-{k:06d}.pose.txt", pose)
    source = tmp_path / "chess" / "seq-01"
    dataset = open_dataset(source)
    assert (kind_of(source), dataset.name, len(dataset), dataset.camera.fx) == ("7scenes", "chess/seq-01", 4, 585.0)
    assert dataset.timestamps_ns.tolist() == [0, 33_333_333, 66_666_667, 100_000_000]
    np.testing.assert_allclose(dataset.ground_truth().T_world_cam, poses, atol=1e-9)
    assert [m.counts_per_metre for m in depth_maps(source, dataset)] == [1000.0] * 4
    points = cloud_of_depth(source, dataset, dataset.ground_truth())
    inside = (points - poses[1][:3, 3]) @ poses[1][:3, :3]
    assert len(points) > 1000 and np.isclose(inside[:, 2], 2.0, atol=0.02).mean() > 0.2
    (source / "frame-000002.pose.txt").write_text("1 0 0 0\n0 1 0 0\n")
    with pytest.raises(InputError, match=r"frame-000002\.pose\.txt"):
        dataset.ground_truth()


def test_icl_nuim_is_mirrored_into_our_frame(tmp_path, poses):
    for k in range(4):
        write_picture(tmp_path / "rgb" / f"{k}.png")
        write_depth(tmp_path / "depth" / f"{k}.png", 10_000)
    (tmp_path / "associations.txt").write_text("".join(f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in range(4)))
    mirror = np.diag([1.0, -1, 1, 1])
    write_tum(Trajectory(np.arange(1, 4) * 10**9, mirror @ poses[1:] @ mirror), tmp_path / "livingRoom0.gt.freiburg")
    dataset = open_dataset(tmp_path)
    assert (kind_of(tmp_path), len(dataset), dataset.camera.fy) == ("icl", 4, 480.0)
    truth = dataset.ground_truth()
    assert truth.timestamps_ns.tolist() == dataset.timestamps_ns.tolist()[1:]
    np.testing.assert_allclose(truth.T_world_cam, poses[1:], atol=1e-8)
    assert np.linalg.det(truth.T_world_cam[:, :3, :3]) == pytest.approx([1.0] * 3)
    assert [m.counts_per_metre for m in depth_maps(tmp_path, dataset)] == [5000.0] * 4


def test_kitti_with_its_poses_in_a_folder_of_their_own(tmp_path, poses):
    source = tmp_path / "dataset" / "sequences" / "07"
    for k in range(4):
        write_picture(source / "image_0" / f"{k:06d}.png")
    (source / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    (source / "calib.txt").write_text("P0: 500 0 320 0 0 500 240 0 0 0 1 0\n")
    (tmp_path / "dataset" / "poses").mkdir()
    np.savetxt(tmp_path / "dataset" / "poses" / "07.txt", poses[:, :3].reshape(4, 12))
    np.testing.assert_allclose(open_dataset(source).ground_truth().T_world_cam, poses, atol=1e-9)
