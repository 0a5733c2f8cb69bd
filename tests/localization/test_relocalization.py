# SPDX-License-Identifier: Apache-2.0
"""The camera is found again after a drop-out, by descriptors and then by the landmarks themselves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vitamin3d.config import Config, RelocalizationConfig
from vitamin3d.datasets import open_dataset
from vitamin3d.geometry.reprojection import reprojection_errors
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.localization.relocalization import RememberedKeyframes, described_corners, is_search_due, landmark_matches, relocalize
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Array, Frame, SlamState, Trajectory

DEMO = open_dataset(Path(__file__).parents[2] / "data" / "demo")
CONFIG = Config()


def run(indices: list[int], config: Config) -> Slam:
    front_end, slam = FrontEnd(config), Slam(DEMO.camera, config)
    for number, index in enumerate(indices):
        frame = DEMO.read(index)
        assert isinstance(frame, Frame)
        slam.process_frame(front_end.process(replace(frame, index=number, timestamp_ns=50_000_000 * number)))
    return slam


def described(slam: Slam) -> list[tuple[int, tuple[Array, Array]]]:
    """All keyframes with their corners."""
    pictures = [DEMO.read(index).image for index in slam.map.frame_indices]
    return [(k, described_corners(picture, CONFIG.relocalization.corners)) for k, picture in enumerate(pictures)]


@pytest.fixture(scope="module")
def before() -> Slam:
    return run(list(range(60)), CONFIG)


def test_a_frame_is_found_from_pictures_and_map_alone(before: Slam) -> None:
    keyframes = described(before)[-4:]
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
    keyframes = described(before)[:1]
    assert not relocalize(black, keyframes, before.map, before.camera, CONFIG.relocalization, CONFIG.localization).converged
    blind = [(0, (pixels, descriptors))]
    assert not relocalize(DEMO.read(61), blind, before.map, before.camera, CONFIG.relocalization, CONFIG.localization).converged
    assert not relocalize(DEMO.read(61), [], before.map, before.camera, CONFIG.relocalization, CONFIG.localization).converged


def test_lent_landmarks_project_where_their_corners_are(before: Slam) -> None:
    frame, settings = DEMO.read(before.poses._last[-1]), CONFIG.relocalization
    corners, (keyframe, mine) = described_corners(frame.image, settings.corners), described(before)[-1]
    ids, rows = landmark_matches(corners, keyframe, mine, before.map, before.camera, settings)
    assert len(ids) == len(rows) > 50 and len(np.unique(rows)) == len(rows) and before.map.is_mapped(ids).all()
    assert np.isin(ids, before.map.obs_landmark[before.map.observations_of(keyframe)]).all()
    pixels = before.camera.undistort(corners[0][rows])
    error = reprojection_errors(before.poses.newest(before.map), before.map.points_world[ids], pixels, before.camera.intrinsics)
    assert (error < 6.0).mean() > 0.8
    far_off = replace(settings, max_distance_px=0.0)
    nobody = landmark_matches(corners, keyframe, mine, before.map, before.camera, far_off)
    assert len(nobody[0]) == len(nobody[1]) == 0


def path_error(estimate: Trajectory, indices: list[int]) -> float:
    """RMSE of the centres after Sim(3); frame n of the estimate is frame indices[n] of the demo."""
    truth = DEMO.ground_truth()
    assert truth is not None
    a, b = estimate.T_world_cam[:, :3, 3], truth.T_world_cam[indices, :3, 3]
    s, R, t = align_sim3(a, b)
    return float(np.sqrt(((s * a @ R.T + t - b) ** 2).sum(axis=1).mean()))


@pytest.mark.slow
def test_a_drop_out_of_two_seconds_is_survived() -> None:
    indices = [*range(60), *range(100, 125)]
    slam = run(indices, CONFIG)
    assert slam.state is SlamState.TRACKING and len(slam.poses) == len(indices)
    assert 1e-5 < path_error(slam.trajectory(), indices) < 0.01


@pytest.mark.slow
def test_a_jump_back_to_the_beginning_is_survived_and_only_by_relocalization() -> None:
    indices = [*range(130), *range(10)]  # too far for the flow
    slam = run(indices, CONFIG)
    assert slam.state is SlamState.TRACKING and len(slam.poses) == len(indices)
    assert 1e-5 < path_error(slam.trajectory(), indices) < 0.01
    without = run(indices, replace(CONFIG, relocalization=RelocalizationConfig(enabled=False)))
    assert without.state is SlamState.LOST and len(without.poses) == 130 and without.localizer._num_lost == 9


@pytest.mark.slow
def test_a_match_that_several_keyframes_lend_counts_once() -> None:
    """From the end to the beginning: few of the newest landmarks are in view, and wrong matches agree six times over."""
    indices = [*range(149), *range(12)]
    slam = run(indices, CONFIG)
    assert len(slam.poses) > 155
    assert path_error(slam.trajectory(), [source for number, source in enumerate(indices) if number in slam.poses]) < 0.01


# --- which keyframes are tried -----------------------------------------------------------------------------------


def remembered(count: int, **settings: int) -> RememberedKeyframes:
    memory = RememberedKeyframes(replace(RelocalizationConfig(), **settings))
    for k in range(count):
        memory.add(k, Frame(k, k, np.full((40, 60), k, np.uint8), np.zeros((40, 60, 3), np.uint8)))
    return memory


def tried(memory: RememberedKeyframes, num_lost: int) -> list[int]:
    return [k for k, _ in memory.to_try(num_lost)]


def test_the_newest_are_remembered_and_every_so_many_th_of_those_before() -> None:
    memory = remembered(31, keyframes=5, stride=4)
    assert sorted(memory._pictures) == [0, 4, 8, 12, 16, 20, 24, 26, 27, 28, 29, 30]
    assert all(frame.color is None and (frame.image == k).all() for k, frame in memory._pictures.items())
    assert sorted(remembered(31, keyframes=5, stride=4, max_remembered=7)._pictures) == [20, 24, 26, 27, 28, 29, 30]


def test_the_newest_are_tried_at_once_then_all_in_turn() -> None:
    memory = remembered(41, keyframes=4, stride=5, tries_at_once=3, interval=5)
    assert all(tried(memory, n) == [40, 39, 38, 37] for n in range(3))
    others = [35, 30, 25, 20, 15, 10, 5, 0]
    turns = [tried(memory, n) for n in range(5, 45, 5)]
    assert all(turn[0] == 40 and len(turn) == len(set(turn)) == 4 and set(turn[1:]) < set(others) for turn in turns)
    assert turns[0][1:] == [20, 15, 10] and {k for turn in turns[:3] for k in turn[1:]} == set(others)
    few = remembered(2)
    assert tried(few, 0) == tried(few, 100) == [1, 0] and tried(remembered(0), 7) == []


def test_the_search_is_made_at_once_then_now_and_then() -> None:
    settings = RelocalizationConfig(tries_at_once=3, interval=5)
    assert [n for n in range(21) if is_search_due(n, settings)] == [0, 1, 2, 5, 10, 15, 20]


def test_keyframes_are_described_once_and_follow_new_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    described: list[int] = []

    def describe(image: Array, count: int) -> tuple[Array, Array]:
        described.append(int(image[0, 0]))
        return np.full((1, 2), float(image[0, 0])), np.zeros((1, 32), np.uint8)

    monkeypatch.setattr("vitamin3d.localization.relocalization.described_corners", describe)
    memory = remembered(10, keyframes=3, stride=3)
    assert sorted(memory._pictures) == [0, 3, 6, 7, 8, 9]
    assert memory.to_try(0) == memory.to_try(1) and described == [9, 8, 7]
    memory.move_to(np.array([0, 2, 6, 7, 9]))
    assert [(k, corners[0][0, 0]) for k, corners in memory.to_try(0)] == [(4, 9.0), (3, 7.0), (2, 6.0)]
    assert described == [9, 8, 7, 6] and sorted(memory._pictures) == [0, 2, 3, 4]
    memory.add(5, Frame(10, 10, np.full((40, 60), 10, np.uint8)))
    assert [int(picture.image[0, 0]) for _, picture in sorted(memory._pictures.items())] == [0, 7, 9, 10]
