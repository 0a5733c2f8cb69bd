# SPDX-License-Identifier: Apache-2.0
"""The camera is found again after a drop-out, by descriptors and then by the landmarks themselves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vitamin3d.config import Config, RelocalizationConfig
from vitamin3d.datasets import open_dataset
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.mapping.relocalization import described_corners, relocalize
from vitamin3d.scale import match_timestamps
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import SlamState

DEMO = open_dataset(Path(__file__).parents[2] / "data" / "demo")
CONFIG = Config()


def run(indices: list[int], config: Config) -> Slam:
    front_end, slam = FrontEnd(config), Slam(DEMO.camera, config)
    for index in indices:
        slam.process_frame(front_end.process(DEMO.read(index)))
    return slam


@pytest.fixture(scope="module")
def before() -> Slam:
    return run(list(range(60)), CONFIG)


def test_a_frame_is_found_from_pictures_and_map_alone(before: Slam) -> None:
    keyframes = [(k, DEMO.read(index)) for k, index in enumerate(before.map.frame_indices)][-4:]
    found = relocalize(DEMO.read(63), keyframes, before.map, before.camera, CONFIG.relocalization, CONFIG.localization)
    assert found.converged and found.is_inlier.sum() >= CONFIG.localization.min_inliers
    expected = before.poses.predict(before.map)
    turned = np.trace(found.T_cam_world[:3, :3] @ expected[:3, :3].T)
    assert np.degrees(np.arccos(np.clip((turned - 1) / 2, -1, 1))) < 6.0
    assert 0.0 < np.linalg.norm(found.T_cam_world[:3, 3] - expected[:3, 3]) < 0.1


def test_a_black_picture_is_not_found(before: Slam) -> None:
    black = replace(DEMO.read(61), image=np.zeros((320, 480), np.uint8))
    pixels, descriptors = described_corners(black.image, 500)
    assert pixels.shape == (0, 2) and descriptors.shape == (0, 32)
    keyframes = [(0, DEMO.read(before.map.frame_indices[0]))]
    assert not relocalize(black, keyframes, before.map, before.camera, CONFIG.relocalization, CONFIG.localization).converged
    assert not relocalize(DEMO.read(61), [], before.map, before.camera, CONFIG.relocalization, CONFIG.localization).converged


def test_a_drop_out_of_more_than_a_second_is_survived_and_only_by_relocalization() -> None:
    indices = [*range(60), *range(95, 125)]
    slam = run(indices, CONFIG)
    assert slam.state is SlamState.TRACKING and len(slam.poses) == len(indices)
    estimate, truth = slam.trajectory(), DEMO.ground_truth()
    assert truth is not None
    i, j = match_timestamps(estimate.timestamps_ns, truth.timestamps_ns, tolerance_ns=0)
    a, b = estimate.T_world_cam[i, :3, 3], truth.T_world_cam[j, :3, 3]
    s, R, t = align_sim3(a, b)
    assert 1e-5 < np.sqrt(((s * a @ R.T + t - b) ** 2).sum(axis=1).mean()) < 0.01
    without = run(indices, replace(CONFIG, relocalization=RelocalizationConfig(enabled=False)))
    assert without.state is SlamState.LOST and len(without.poses) <= 61
