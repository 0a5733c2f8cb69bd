# SPDX-License-Identifier: Apache-2.0
"""The map that forgets: what is left is what it was, and a run that forgets goes where one that does not goes."""

import dataclasses

import numpy as np
import pytest

from vitamin3d.atlas import Atlas
from vitamin3d.config import Config, MemoryConfig
from vitamin3d.localization.pose_log import PoseLog
from vitamin3d.mapping.map_condensation import condense, condensed, contributions, redundant_keyframes
from vitamin3d.runtime import RunRecord, run_sequential
from vitamin3d.sparse_map import SparseMap
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Frame


def some_map(rng, keyframes=12, ids=60):
    """Keyframes that see random tracks, half of them landmarks, some observations removed."""
    made = SparseMap()
    for k in range(keyframes):
        seen = np.sort(rng.choice(ids, ids // 2, replace=False))
        pose = np.eye(4)
        pose[:3, 3] = rng.normal(size=3)
        colors, patches = rng.integers(0, 255, (len(seen), 3)), rng.integers(0, 255, (len(seen), 81))
        made.add_keyframe(10 * k, 1000 * k, pose, seen, rng.normal(size=(len(seen), 2)), colors, patches, rng.normal(size=(6, 2)), 0.1 * k)
    landmarks = rng.choice(ids, ids // 2, replace=False)
    made.points_world[landmarks] = rng.normal(size=(len(landmarks), 3))
    made.remove_observations(rng.choice(len(made.obs_landmark), 40, replace=False))
    made.remove_landmarks(landmarks[:3])
    return made


def counting(sparse_map, keyframe, id_):
    """Pixels of the observations of a track in a keyframe that count."""
    rows = sparse_map.observations_of(keyframe)
    found = []
    for i in range(rows.start, rows.stop):
        first = sparse_map.first_observation[id_]
        if sparse_map.obs_landmark[i] == id_ and sparse_map.obs_valid[i] and 0 <= first <= i:
            found.append(tuple(sparse_map.obs_pixels[i]))
    return found


def test_what_stays_is_what_it_was(rng):
    old, needed = some_map(rng), np.array([1, 5, 20, 70])
    keyframes = np.array([0, 2, 3, 5, 8, 9, 11])
    new = condensed(old, keyframes, needed)
    kept = new.remembered_ids
    assert set(needed) <= set(kept) and (np.diff(kept) > 0).all() and len(new.points_world) == (kept < 60).sum()
    assert new.frame_indices == [10 * k for k in keyframes] and new.timestamps_ns == [1000 * k for k in keyframes]
    np.testing.assert_array_equal(new.T_cam_world, old.T_cam_world[keyframes])
    np.testing.assert_array_equal(new.image_motions, old.image_motions[keyframes])
    np.testing.assert_array_equal(new.position_deviations_deg, 0.1 * keyframes)
    seen_again = 0
    for id_ in range(60):
        pixels = [counting(old, k, id_) for k in keyframes]
        number = sum(map(len, pixels))
        is_landmark = bool(old.is_mapped(np.array([id_]))[0]) and number >= 2
        assert (id_ in kept) == (is_landmark or id_ in needed)
        if id_ in kept:
            at = int(np.searchsorted(kept, id_))
            assert [counting(new, k, at) for k in range(len(keyframes))] == pixels
            assert new.num_observations[at] == number and bool(new.is_mapped(np.array([at]))[0]) == is_landmark
            seen_again += is_landmark
            if is_landmark:
                np.testing.assert_array_equal(new.points_world[at], old.points_world[id_])
                np.testing.assert_array_equal(new.patches[at], old.patches[id_])
                rows = np.flatnonzero(new.obs_landmark == at)
                assert (new.first_observation[at], new.last_observation[at]) == (rows[0], rows[-1])
    assert seen_again > 10


def test_landmarks_with_few_observations_stay_while_they_are_recent(rng):
    old = some_map(rng)
    everything, recent = np.arange(12), 3
    kept = condensed(old, everything, np.zeros(0, np.int64), 5, recent).remembered_ids
    for id_ in np.flatnonzero(~np.isnan(old.points_world[:, 0])):
        number = sum(len(counting(old, k, id_)) for k in everything)
        stays = number >= 5 or (number >= 2 and old.keyframe_of(old.last_observation[id_]) >= 12 - recent)
        assert (id_ in kept) == stays
    assert 0 < len(kept) < (~np.isnan(old.points_world[:, 0])).sum()


def test_contributions_are_the_obvious_sum(rng):
    made = some_map(rng)
    expected = np.zeros(made.num_keyframes)
    for id_ in np.flatnonzero(~np.isnan(made.points_world[:, 0])):
        observers = [k for k in range(made.num_keyframes) if counting(made, k, id_)]
        expected[observers] += 1.0 / max(1, made.num_observations[id_])
    np.testing.assert_allclose(contributions(made), expected)


def test_redundant_keyframes_add_least_and_are_no_neighbours(rng):
    made = some_map(rng, 30)
    dropped = redundant_keyframes(made, 6, 5)
    assert len(dropped) == 6 and dropped.min() > 0 and dropped.max() < 25 and np.diff(dropped).min() > 1
    assert contributions(made)[1:25].argmin() + 1 in dropped
    assert len(redundant_keyframes(made, 100, 5)) <= 12


def test_too_many_keyframes_become_fewer(rng):
    done = condense(some_map(rng, 30), np.arange(4), 5, MemoryConfig(max_keyframes=20, dropped_share=0.3))
    assert done.map.num_keyframes == 24 and set(range(25, 30)) <= set(done.kept_keyframes)
    assert condense(some_map(rng, 18), np.arange(4), 5, MemoryConfig(max_keyframes=20)).map.num_keyframes == 18


def test_poses_stay_where_they_were(rng):
    made, log = some_map(rng), PoseLog()
    for index in range(115):
        pose = np.eye(4)
        pose[:3, 3] = rng.normal(size=3)
        log.add_world(Frame(index, 100 * index, np.zeros((2, 2), np.uint8)), pose, made)
    before, motion = log.trajectory(made), log.predict(made)
    kept = np.array([0, 3, 4, 9, 11])
    log.move_to(kept, made)
    smaller = condensed(made, kept, np.arange(3))
    after = log.trajectory(smaller)
    np.testing.assert_array_equal(after.timestamps_ns, before.timestamps_ns)
    np.testing.assert_allclose(after.T_world_cam, before.T_world_cam, atol=1e-12)
    np.testing.assert_allclose(log.predict(smaller), motion, atol=1e-12)


def run(demo, memory):
    config = Config(memory=memory)
    atlas, record = Atlas(demo.camera, config), RunRecord(tracks=[])
    run_sequential(demo, range(90), FrontEnd(config), atlas, record=record)
    return atlas.ranked()[0], record


@pytest.fixture(scope="module")
def unforgetting(demo):
    return run(demo, MemoryConfig())


@pytest.mark.slow
def test_forgetting_dead_tracks_changes_nothing(demo, unforgetting):
    (a, record_a), (b, record_b) = unforgetting, run(demo, MemoryConfig(max_new_tracks=700))
    assert len(b.times.milliseconds["condense"]) > 3 and "condense" not in a.times.milliseconds
    np.testing.assert_array_equal(a.trajectory().T_world_cam, b.trajectory().T_world_cam)
    assert len(b.map.obs_landmark) < len(a.map.obs_landmark) and len(b.map.points_world) < len(a.map.points_world)
    good = [~np.isnan(slam.map.points_world[:, 0]) & (slam.map.num_observations >= 3) for slam in (a, b)]
    np.testing.assert_array_equal(a.map.points_world[good[0]], b.map.points_world[good[1]])
    for (_, ids_a, pixels_a), (_, ids_b, pixels_b) in zip(record_a.tracks, record_b.tracks, strict=True):
        np.testing.assert_array_equal(pixels_a, pixels_b)
        np.testing.assert_array_equal(ids_a, ids_b)


@pytest.mark.slow
def test_a_run_with_few_keyframes_goes_the_same_way(demo, unforgetting, monkeypatch):
    monkeypatch.setattr("vitamin3d.mapping.keyframe_handover.UNTAKEN_KEYFRAMES", 2)  # else so few could not be spared
    config = Config(memory=MemoryConfig(max_keyframes=8), window=dataclasses.replace(Config().window, keyframes=1))
    atlas = Atlas(demo.camera, config)
    run_sequential(demo, range(90), FrontEnd(config), atlas)
    slam = atlas.ranked()[0]
    assert slam.map.num_keyframes <= 9 and len(slam.times.milliseconds["condense"]) >= 1
    path, other = slam.trajectory(), unforgetting[0].trajectory()
    assert len(path) == len(other) == 90
    a, b = (np.linalg.norm(np.diff(t.T_world_cam[:, :3, 3], axis=0), axis=1).sum() for t in (path, other))
    assert abs(a / b - 1) < 0.1
