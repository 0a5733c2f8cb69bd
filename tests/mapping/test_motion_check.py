# SPDX-License-Identifier: Apache-2.0
"""A bent map is told from a sound one by the tracks of two of its keyframes; the map that follows inherits what was bent."""

import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE, arc_scene, map_of, project, with_noise

from vitamin3d.atlas import Atlas
from vitamin3d.config import Config, MotionCheckConfig
from vitamin3d.geometry.epipolar_refinement import best_motion, motion_cost
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.mapping.motion_check import MotionCheck, second_opinion
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Frame, SlamState

CONFIG = MotionCheckConfig(max_keyframes=6)
BEND = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.radians(4.0), 0.0]))


def arc_map(rng, num_keyframes=10, bent_from=None, num_points=300):
    """Keyframes on an arc with noisy pixels; from one of them on the cameras are turned by 4 degrees together, wrongly."""
    sparse_map = map_of(with_noise(arc_scene(num_keyframes, num_points, rng), rng, 0.3, 0.02)[0])
    for k in range(num_keyframes if bent_from is None else bent_from, num_keyframes):
        sparse_map.T_cam_world[k] = sparse_map.T_cam_world[k] @ BEND
    return sparse_map


def test_two_keyframes_agree_with_a_sound_map(rng):
    opinion = second_opinion(arc_map(rng), PINHOLE, CONFIG)
    assert opinion.keyframe == 9 - CONFIG.max_keyframes
    assert 1.0 <= opinion.cost_ratio < 1.1 and opinion.turn_deg < 0.2 and opinion.direction_deg < 2.0


def test_they_contradict_a_bent_one_and_say_by_how_much(rng):
    opinion = second_opinion(arc_map(rng, bent_from=6), PINHOLE, CONFIG)
    assert opinion.cost_ratio > 2.0 and opinion.turn_deg == pytest.approx(4.0, abs=0.3)


def test_a_bend_before_both_keyframes_is_not_seen_and_harms_neither(rng):
    assert second_opinion(arc_map(rng, bent_from=2), PINHOLE, CONFIG).cost_ratio < 1.1


def test_with_few_shared_landmarks_there_is_no_opinion(rng):
    sparse_map = arc_map(rng, num_points=300)
    assert second_opinion(sparse_map, PINHOLE, dataclasses.replace(CONFIG, min_pairs=301)) is None
    newest = np.flatnonzero(sparse_map.keyframe_of(np.arange(len(sparse_map.obs_landmark))) == 9)
    sparse_map.obs_valid[newest[40:]] = False
    assert second_opinion(sparse_map, PINHOLE, CONFIG) is None
    assert second_opinion(sparse_map, PINHOLE, dataclasses.replace(CONFIG, min_pairs=20)) is not None


def test_tracks_that_are_no_landmarks_have_no_say(rng):
    """What moves by itself must not bend a map, be it the majority."""
    sparse_map, moved = arc_map(rng), inverse(BEND)
    for row in np.flatnonzero((sparse_map.obs_landmark < 200) & (sparse_map.keyframe_of(np.arange(len(sparse_map.obs_landmark))) >= 6)):
        T = sparse_map.T_cam_world[sparse_map.keyframe_of(row)] @ moved
        sparse_map.obs_pixels[row] = project(PINHOLE, T, sparse_map.points_world[sparse_map.obs_landmark[row]][None])[0]
    assert second_opinion(sparse_map, PINHOLE, CONFIG).cost_ratio > 1.5
    sparse_map.remove_landmarks(np.arange(200))
    assert second_opinion(sparse_map, PINHOLE, CONFIG).cost_ratio < 1.1


def test_a_camera_that_rests_has_no_direction(rng):
    sparse_map = arc_map(rng)
    sparse_map.T_cam_world[:] = sparse_map.T_cam_world[0]
    assert second_opinion(sparse_map, PINHOLE, CONFIG) is None


def test_it_takes_doubts_in_a_row_and_names_the_keyframe_before_the_bend(rng):
    check, sound, bent = MotionCheck(CONFIG), arc_map(rng, 7), arc_map(rng, 10, bent_from=6)
    assert not check.is_bent(sound, PINHOLE) and check.last_sound(sound, PINHOLE) == 6
    assert not check.is_bent(bent, PINHOLE) and check.is_due(9) and check.is_bent(bent, PINHOLE)
    check = MotionCheck(CONFIG)
    assert not check.is_bent(bent, PINHOLE) and check.last_sound(bent, PINHOLE) == 5  # the last that agrees with those before
    assert not check.is_bent(arc_map(rng, 10), PINHOLE) and not check.is_due(9)  # and the doubt is over
    assert not check.is_bent(bent, PINHOLE)


def test_while_there_is_no_doubt_it_is_due_every_few_keyframes():
    check = MotionCheck(CONFIG)
    assert [k for k in range(1, 13) if check.is_due(k)] == [4, 8, 12]


def two_halves(rng, num_shared):
    """A map of 12 keyframes whose later half sees other landmarks than its first one, but for some."""
    sparse_map = arc_map(rng, 12)
    later = np.arange(sparse_map.keyframe_starts[6], len(sparse_map.obs_landmark))
    ids = sparse_map.obs_landmark[: sparse_map.keyframe_starts[6]]
    early = np.arange(len(ids))
    sparse_map.remove_observations(early[(ids >= 150)])
    sparse_map.remove_observations(later[sparse_map.obs_landmark[later] < 150 - num_shared])
    return sparse_map


def test_what_nothing_links_to_the_sound_keyframes_is_cut_off(rng):
    apart, linked = two_halves(rng, 20), two_halves(rng, 40)  # fewer and more than a link needs, and too few for an opinion
    for sparse_map, is_cut_off in ((apart, True), (linked, False)):
        check = MotionCheck(CONFIG)
        assert check.is_bent(sparse_map, PINHOLE) == is_cut_off
        assert (check.last_sound(sparse_map, PINHOLE) == 5) == is_cut_off
    assert not MotionCheck(dataclasses.replace(CONFIG, min_pairs_of_a_link=10)).is_bent(apart, PINHOLE)


def test_a_map_that_is_bent_soon_after_a_doubtful_link_ends_before_it(rng):
    sparse_map = arc_map(rng, 12, bent_from=6)  # seen from keyframe 11 six keyframes back all agree
    strict = dataclasses.replace(CONFIG, max_keyframes=4, linked_ratio=1e9)
    check = MotionCheck(strict)
    assert not check.is_bent(sparse_map, PINHOLE) and check.last_sound(sparse_map, PINHOLE) == 5
    longer = MotionCheck(dataclasses.replace(strict, linked_ratio=1.0))
    assert longer.is_bent(sparse_map, PINHOLE) and longer.last_sound(sparse_map, PINHOLE) == 5


def test_a_difference_that_is_small_is_no_bend(rng):
    bent, check = arc_map(rng, 10, bent_from=6), MotionCheck(dataclasses.replace(CONFIG, min_turn_deg=10.0, min_direction_deg=80.0))
    assert not any(check.is_bent(bent, PINHOLE) for _ in range(4))
    check = MotionCheck(dataclasses.replace(CONFIG, enabled=False))
    assert not any(check.is_bent(bent, PINHOLE) for _ in range(4))


def test_the_last_sound_keyframe_is_numbered_anew_with_the_map(rng):
    check = MotionCheck(CONFIG)
    check.is_bent(arc_map(rng, 7), PINHOLE)
    check.move_to(np.array([0, 2, 4, 5, 8]))
    assert check.last_sound(arc_map(rng, 4), PINHOLE) == 3  # keyframe 5, the last one kept of those up to 6


def test_the_best_motion_costs_less_than_the_true_one_and_is_near_it(rng):
    T_1_0 = exp_se3(np.array([0.5, 0.1, 0.1, 0.02, -0.05, 0.01]))
    points = rng.uniform([-2, -1.5, 3], [2, 1.5, 8], (300, 3))
    pixels = [project(PINHOLE, T, points) + 0.3 * rng.standard_normal((300, 2)) for T in (np.eye(4), T_1_0)]
    rays, sigma = [PINHOLE.rays_from_ideal(p) for p in pixels], 1.0 / PINHOLE.fx
    R, t = T_1_0[:3, :3], T_1_0[:3, 3]
    motion = best_motion(exp_se3(np.array([0, 0, 0, 0.03, 0.0, 0.0]))[:3, :3] @ R, np.array([1.0, 0.0, 0.0]), *rays, sigma)
    assert motion.cost <= motion_cost(R, t, *rays, sigma)
    assert motion_cost(R, 7.0 * t, *rays, sigma) == pytest.approx(motion_cost(R, t, *rays, sigma))  # the length does not matter
    assert motion.cost == pytest.approx(motion_cost(motion.R, motion.t, *rays, sigma))
    assert np.degrees(np.arccos(0.5 * (np.trace(motion.R @ R.T) - 1.0))) < 0.3
    assert abs(motion.t @ t) / np.linalg.norm(t) > np.cos(np.radians(3.0))


# --- what becomes of a bent map ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bent_film(demo):
    """The demo, whose map is called bent since its keyframe 6 at the first check with 13 keyframes or more."""
    called = []

    def is_bent(self, sparse_map, camera):
        if not called and sparse_map.num_keyframes > 12:
            called.append((sparse_map.frame_indices[7], sparse_map.frame_indices[-1]))
            return True
        return False

    front_end, atlas, states, ids = FrontEnd(Config()), Atlas(demo.camera, Config()), [], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MotionCheck, "is_bent", is_bent)
        patch.setattr(MotionCheck, "last_sound", lambda self, sparse_map, camera: 6)
        for index in range(110):
            states.append(atlas.process_frame(front_end.process(Frame(index, index * 50_000_000, demo.read(index).image))))
            slam = atlas.current
            ids.append((slam.number, slam.tracks.ids.copy()))
    atlas.finish()
    return atlas, called[0], states, ids


def path_error(slam, demo):
    frames = [index for index in range(110) if index in slam.poses]
    a, b = slam.trajectory().T_world_cam[:, :3, 3], demo.ground_truth().T_world_cam[frames, :3, 3]
    s, R, t = align_sim3(a, b)
    return np.sqrt(((s * a @ R.T + t - b) ** 2).sum(axis=1).mean())


def test_a_bent_map_ends_with_its_last_sound_keyframe(bent_film):
    atlas, (doubted, found), _, _ = bent_film
    old = next(slam for slam in atlas.ranked() if slam.number == 0)
    assert 0 < doubted < found < 110 and old.map.num_keyframes == 7 and old.map.frame_indices[-1] < doubted
    assert [index for index in range(110) if index in old.poses] == list(range(doubted))  # those before the next keyframe stay
    assert atlas.left == [old] and atlas.active is not old
    assert np.isfinite(old.map.T_cam_world).all() and old.map.num_observations.max() <= old.map.num_keyframes


def test_the_camera_is_tracked_on_in_the_same_frame(bent_film, demo):
    atlas, (_, found), states, _ = bent_film
    assert states[found] is SlamState.TRACKING and SlamState.LOST not in states[found:]
    covered = {index for slam in atlas.ranked() for index in range(110) if index in slam.poses}
    assert len(covered) >= 100
    assert all(path_error(slam, demo) < 0.01 for slam in atlas.ranked())


def test_tracks_that_are_handed_over_keep_their_ids(bent_film):
    atlas, (_, found), _, ids = bent_film
    (_, before), (number, after) = ids[found - 1], ids[found]
    assert number != 0 and len(after) > 100 and len(np.unique(after)) == len(after)
    assert np.isin(after, before).mean() > 0.8
    new = next(slam for slam in atlas.ranked() if slam.number == number)
    later = np.concatenate([own for n, own in ids[found + 1 :] if n == number])
    assert (new.map.rows_of(later) >= 0).all() and later.max() > before.max()


def test_keyframes_that_were_bent_are_not_handed_to_the_dense_half(bent_film):
    atlas, (doubted, found), _, _ = bent_film
    taken = atlas.take_settled_keyframes(everything=True)
    assert not any(slam.number == 0 and doubted <= frame.index <= found for slam, _, frame in taken)
    assert all(slam.map.frame_indices[k] == frame.index for slam, k, frame in taken)


def test_centres_of_both_maps_are_the_film(bent_film):
    atlas = bent_film[0]
    for slam in atlas.ranked():
        steps = np.linalg.norm(np.diff(inverse(slam.map.T_cam_world)[:, :3, 3], axis=0), axis=1)
        assert steps.max() < 10 * np.median(steps)
