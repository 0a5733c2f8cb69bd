# SPDX-License-Identifier: Apache-2.0
"""The maps of a run: cuts, black pictures, false starts, and what is kept of them."""

import dataclasses

import cv2
import numpy as np
import pytest

from vitamin3d.atlas import Atlas
from vitamin3d.config import AtlasConfig, Config
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.localization.localizer import Localizer
from vitamin3d.mapping.landmark_triangulation import Rigidity
from vitamin3d.mapping.window_adjustment import AdjustAtOnce
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Frame, SlamState

PERIOD_NS = 50_000_000
UNLOCALISED = (SlamState.INITIALIZING, SlamState.ROTATING, SlamState.LOST)


def track(demo, pictures, config=None, start_ns=10**18):
    """An atlas of a film, and after each frame its state and the tracks' ids."""
    config = config or Config()
    front_end, atlas, ids = FrontEnd(config), Atlas(demo.camera, config), []
    for index, picture in enumerate(pictures):
        state = atlas.process_frame(front_end.process(Frame(index, start_ns + index * PERIOD_NS, picture)))
        assert state is atlas.notes[-1].state
        ids.append(atlas.current.tracks.ids)
    return atlas, ids


def frames_of(slam, count):
    return [index for index in range(count) if index in slam.poses]


def path_error(slam, demo, sources):
    """RMSE of the centres after Sim(3), metres; frame n of the film is a frame of the demo."""
    path, truth = slam.trajectory(), demo.ground_truth()
    a, b = path.T_world_cam[:, :3, 3], truth.T_world_cam[[sources[k] for k in frames_of(slam, len(sources))], :3, 3]
    s, R, t = align_sim3(a, b)
    return np.sqrt(((s * a @ R.T + t - b) ** 2).sum(axis=1).mean())


@pytest.fixture(scope="module")
def plain(demo):
    return [demo.read(index).image for index in range(150)]


@pytest.fixture(scope="module")
def flipped(plain):
    return [cv2.flip(picture, -1) for picture in plain]


@pytest.fixture(scope="module")
def cut(demo, plain, flipped):
    return track(demo, plain[:70] + flipped[70:])


# --- a cut -----------------------------------------------------------------------------------------------------------


def test_a_cut_film_has_two_maps_one_after_the_other(demo, cut):
    atlas, _ = cut
    later, earlier = atlas.ranked()
    assert (earlier.number, later.number) == (0, 1) and atlas.left == [earlier] and atlas.active is atlas.current is later
    assert len(frames_of(earlier, 150)) >= 69 and len(frames_of(later, 150)) >= 79
    assert max(frames_of(earlier, 150)) <= 69 < 70 <= min(frames_of(later, 150))
    assert max(path_error(slam, demo, range(150)) for slam in (earlier, later)) < 0.01
    assert earlier.map.num_keyframes >= 5 and later.map.num_keyframes >= 5
    assert earlier.map.frame_indices[-1] < 70 <= later.map.frame_indices[0]


def test_each_frame_has_its_note(cut):
    notes = cut[0].notes
    assert [note.index for note in notes] == list(range(150))
    assert [note.timestamp_ns for note in notes] == [10**18 + k * PERIOD_NS for k in range(150)]
    assert [note.index for note in notes if not note.continues] == [0, 70]
    assert all(note.state in UNLOCALISED for note in (*notes[:5], *notes[70:75]))
    assert all(note.state is SlamState.TRACKING for note in (*notes[40:70], *notes[110:]))
    assert {note.map_number for note in notes[:70]} == {0} and {note.map_number for note in notes[70:]} == {1}
    assert all(note.reason for note in notes if note.state is SlamState.INITIALIZING) and not any(n.reason for n in notes[40:70])
    assert all(note.num_extrema > 500 and note.num_tracks > 500 and note.contrast > 20 and 50 < note.brightness < 200 for note in notes)
    assert all((note.motion_px > 0) == note.continues and note.motion_px < 30 for note in notes)


def test_tracks_of_two_maps_never_share_an_id(cut):
    _, ids = cut
    before, after = np.unique(np.concatenate(ids[:70])), np.unique(np.concatenate(ids[70:]))
    assert len(before) > 3000 and len(after) > 3000 and len(np.intersect1d(before, after)) == 0
    assert before.max() < after.min()


@pytest.mark.slow
def test_keyframes_come_with_their_map_and_once(demo, plain, flipped):
    front_end, atlas, taken = FrontEnd(Config()), Atlas(demo.camera, Config()), []
    for index, picture in enumerate(plain[:70] + flipped[70:]):
        atlas.process_frame(front_end.process(Frame(index, index * PERIOD_NS, picture)))
        taken += atlas.take_settled_keyframes()
    taken += atlas.take_settled_keyframes(everything=True)
    keys = [(slam.number, keyframe) for slam, keyframe, _ in taken]
    assert sorted(keys) == [(slam.number, k) for slam in atlas.ranked()[::-1] for k in range(slam.map.num_keyframes)]
    assert all(slam.map.frame_indices[keyframe] == frame.index for slam, keyframe, frame in taken)
    numbers = [slam.snapshot(keyframe, frame).map_number for slam, keyframe, frame in (taken[0], taken[-1])]
    assert numbers == [0, 1] and atlas.take_settled_keyframes(everything=True) == []


@pytest.mark.slow
def test_the_same_film_gives_the_same_maps(demo, plain, flipped, cut):
    again, ids = track(demo, plain[:70] + flipped[70:])
    for a, b in zip(cut[0].ranked(), again.ranked(), strict=True):
        pairs = (a.trajectory().T_world_cam, b.trajectory().T_world_cam), (a.map.points_world, b.map.points_world)
        assert all(x.tobytes() == y.tobytes() for x, y in pairs) and a.camera == b.camera
        assert a.map.frame_indices == b.map.frame_indices and a.map.obs_pixels.tobytes() == b.map.obs_pixels.tobytes()
    assert cut[0].notes == again.notes
    assert all(np.array_equal(x, y) for x, y in zip(cut[1], ids, strict=True))


# --- breaks that are survived ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dark(demo, plain):
    """A covered lens: one second, while the camera stands still."""
    return track(demo, plain[:60] + [np.zeros_like(plain[0])] * 20 + plain[60:])


@pytest.mark.slow
def test_a_black_second_is_within_one_map(demo, dark):
    atlas, _ = dark
    (slam,) = atlas.ranked()
    assert slam.number == 0 and frames_of(slam, 170) == [*range(60), *range(80, 170)]
    assert path_error(slam, demo, [*range(60), *[0] * 20, *range(60, 150)]) < 0.01
    assert atlas.successor is None and atlas.left == [] and atlas.active is slam


@pytest.mark.slow
def test_notes_tell_that_the_pictures_were_black(dark):
    notes = dark[0].notes
    black = notes[60:80]
    assert all(note.contrast == note.brightness == note.motion_px == note.num_extrema == note.num_tracks == 0 for note in black)
    assert not any(note.continues or note.state in (SlamState.TRACKING, SlamState.UNCERTAIN) for note in black)
    assert all(note.continues and note.state is SlamState.TRACKING and note.map_number == 0 for note in notes[80:])


@pytest.mark.slow
@pytest.mark.parametrize("sources", [[149], [149, 20], [149, 20, 90, 90]])
def test_stray_pictures_cost_their_own_frames_alone(demo, plain, sources):
    strays, count = [plain[k][::-1].copy() for k in sources], len(sources)  # mirrored: no rotation brings it about
    atlas, ids = track(demo, [*plain[:60], *strays, *plain[60:90]])
    (slam,) = atlas.ranked()
    assert frames_of(slam, 90 + count) == [*range(60), *range(60 + count, 90 + count)]
    assert len(np.intersect1d(ids[59], ids[60 + count])) > 0.7 * len(ids[59])  # the tracks live on


@pytest.mark.slow
def test_a_false_start_is_left_behind(demo, plain, flipped):
    atlas, _ = track(demo, flipped[110:140] + plain)
    largest = atlas.ranked()[0]
    found = frames_of(largest, 180)
    assert sum(index >= 30 for index in found) >= 140 and path_error(largest, demo, [*range(110, 140), *range(150)]) < 0.01
    assert len(atlas.notes) == 180


@pytest.mark.slow
def test_a_map_that_is_lost_young_is_dropped_or_kept_as_the_settings_say(demo, plain, flipped):
    film = plain[:33] + flipped[110:]
    assert [slam.number for slam in track(demo, film)[0].ranked()] == [1]
    patient = dataclasses.replace(Config(), atlas=AtlasConfig(min_keyframes=2, min_frames=2))
    atlas, _ = track(demo, film, patient)
    assert [slam.number for slam in atlas.ranked()] == [1, 0] and max(frames_of(atlas.ranked()[1], 73)) == 32


def test_nothing_but_black_or_one_picture_is_no_map(demo, plain):
    for pictures in ([np.zeros_like(plain[0])] * 12, [plain[0]] * 12, []):
        atlas, _ = track(demo, pictures)
        assert atlas.ranked() == [] and len(atlas.notes) == len(pictures) and atlas.adjustments_awaited == 0
        atlas.finish()
        assert atlas.take_settled_keyframes(everything=True) == []


# --- maps that are false ---------------------------------------------------------------------------------------------

RIGID, FALSE = Rigidity(100_000, 60_000), Rigidity(100_000, 20_000)


def judged(demo, pictures, judgements, adjuster=None, config=None):
    """An atlas of a film; after some frames the tracks of the current map are said to have been rigid or not."""
    config = config or Config()
    front_end, atlas, numbers = FrontEnd(config), Atlas(demo.camera, config), []
    atlas.adjuster.work_with(adjuster or AdjustAtOnce())
    for index, picture in enumerate(pictures):
        atlas.process_frame(front_end.process(Frame(index, index * PERIOD_NS, picture)))
        numbers.append(atlas.current.number)
        if index in judgements:
            atlas.current.mapper.rigidity = dataclasses.replace(judgements[index])
    return atlas, numbers


@pytest.mark.slow
def test_tracks_of_a_rigid_scene_agree_with_its_map(cut, dark):
    for slam in (*cut[0].ranked(), *dark[0].ranked()):
        assert slam.mapper.rigidity.num_tracks > 300 and slam.mapper.rigidity.share > 0.5


@pytest.mark.slow
def test_a_false_map_is_dropped_and_made_anew(demo, plain):
    atlas, numbers = judged(demo, plain[:110], {39: RIGID, 49: FALSE})
    (slam,) = atlas.ranked()
    assert numbers == [0] * 50 + [1] * 60 and atlas.active is slam and slam.number == 1
    assert atlas.left == [] and atlas.successor is None
    assert min(frames_of(slam, 110)) >= 50 and len(frames_of(slam, 110)) > 50
    assert path_error(slam, demo, range(110)) < 0.01
    assert atlas.notes[50].state is SlamState.INITIALIZING and atlas.notes[-1].state is SlamState.TRACKING
    assert all(taken is slam for taken, _, _ in atlas.take_settled_keyframes(everything=True))


@pytest.mark.slow
def test_a_map_is_judged_by_many_tracks_and_by_less_than_the_least_share(demo, plain):
    atlas_config = Config().atlas
    few, least = Rigidity(atlas_config.judged_tracks - 1, 0), Rigidity(1000, round(1000 * atlas_config.min_rigid_share))
    just_below = Rigidity(atlas_config.judged_tracks, int(atlas_config.min_rigid_share * atlas_config.judged_tracks) - 1)
    for judgement, is_dropped in ((few, False), (least, False), (just_below, True)):
        assert judged(demo, plain[:42], {40: judgement})[1][-1] == int(is_dropped), judgement


@pytest.mark.slow
def test_keyframes_of_a_false_map_are_not_handed_over(demo, plain):
    soon = dataclasses.replace(Config(), window=dataclasses.replace(Config().window, settled_keyframes=2))
    for judgement, is_false in ((FALSE, True), (RIGID, False)):
        atlas, _ = judged(demo, plain[:60], {59: judgement}, config=soon)
        assert atlas.active.number == 0 and (atlas.take_settled_keyframes() == []) == is_false


@pytest.mark.slow
def test_a_false_successor_is_made_anew_and_the_older_map_stays(demo, plain, flipped):
    atlas, numbers = judged(demo, plain[:70] + flipped[70:], {90: FALSE})  # while the camera is sought in the older one too
    assert [note.state for note in atlas.notes[90:93]] == [SlamState.TRACKING, SlamState.INITIALIZING, SlamState.INITIALIZING]
    assert numbers[70:91] == [1] * 21 and numbers[92:] == [2] * 58
    earlier, later = sorted(atlas.ranked(), key=lambda slam: slam.number)
    assert (earlier.number, later.number) == (0, 2) and atlas.left == [earlier] and min(frames_of(later, 150)) > 90
    assert max(path_error(slam, demo, range(150)) for slam in (earlier, later)) < 0.01


@pytest.mark.slow
def test_a_false_map_is_neither_left_behind_nor_inherited_from(demo, plain):
    wrong = dataclasses.replace(demo.camera, fx=1.02 * demo.camera.fx, fy=1.02 * demo.camera.fy)
    atlas, _ = judged(demo, plain[:60], {})
    atlas.active.mapper.camera, atlas.active.mapper.rigidity = wrong, dataclasses.replace(FALSE)
    atlas.process_frame(FrontEnd(Config()).process(Frame(60, 60 * PERIOD_NS, plain[60])))
    assert atlas.active.number == 1 and atlas.active.camera == demo.camera and atlas.left == []


class Late:
    """Adjusts at once, and gives the result when it is waited for or after it was asked a few times."""

    def __init__(self):
        self.result, self.asked = None, 0

    @property
    def is_busy(self):
        return self.result is not None

    def begin(self, task):
        assert not self.is_busy, "one thing at a time"
        self.result, self.asked = task(), 0

    def take(self, wait=False):
        self.asked += 1
        if self.result is None or not (wait or self.asked > 2):
            return None
        result, self.result = self.result, None
        return result


@pytest.mark.slow
def test_a_false_map_takes_its_adjustment_with_it(demo, plain):
    """In live runs a window is being adjusted beside the tracking when its map is dropped: the next map must not get it."""
    first, _ = judged(demo, plain[:50], {}, Late())
    adjusted = first.active.map.frame_indices[Config().bundle_adjustment.keyframe_interval]
    adjuster = Late()
    judged(demo, plain[: adjusted + 1], {}, adjuster)
    assert adjuster.is_busy
    atlas, numbers = judged(demo, plain[:90], {adjusted: FALSE}, Late())
    (slam,) = atlas.ranked()
    assert numbers[adjusted : adjusted + 2] == [0, 1] and slam.number == 1
    assert path_error(slam, demo, range(90)) < 0.01


# --- poses that hang on little ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_pose_without_known_landmarks_adds_nothing_to_the_map(demo, plain):
    """For so many frames in a row; then the camera is looked for."""
    doubting = dataclasses.replace(Config(), localization=dataclasses.replace(Config().localization, min_known=10**6))
    atlas, _ = track(demo, plain[:90], doubting)
    slam = atlas.active
    states = [note.state for note in atlas.notes]
    first, most = states.index(SlamState.UNCERTAIN), doubting.localization.max_loose_frames
    assert not any(states[index] is SlamState.UNCERTAIN for index in slam.map.frame_indices)
    assert slam.map.frame_indices[2 * doubting.localization.loose_observations - 1] < first  # a young map does not know better
    assert states[first : first + most + 1] == [SlamState.UNCERTAIN] * most + [SlamState.TRACKING]  # found again at once
    assert frames_of(slam, 90) == list(range(90)) and path_error(slam, demo, range(90)) < 0.01


# --- what maps share -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_next_map_begins_with_the_refined_camera(demo, plain, flipped):
    eager = dataclasses.replace(Config(), calibration=dataclasses.replace(Config().calibration, refine="on", first_keyframes=6))
    wrong = dataclasses.replace(demo.camera, fx=1.02 * demo.camera.fx, fy=1.02 * demo.camera.fy)
    assert isinstance(wrong, PinholeCamera)
    front_end, atlas = FrontEnd(eager), Atlas(wrong, eager)
    for index, picture in enumerate(plain[:80] + flipped[80:83]):
        atlas.process_frame(front_end.process(Frame(index, index * PERIOD_NS, picture)))
    first, second = atlas.active, atlas.successor
    assert first.number == 0 and first.map.num_keyframes and first.camera != wrong and second.number == 1
    calibration = second.mapper.calibration
    assert second.camera == second.tracker.camera == first.camera and calibration.given == wrong and calibration.history == []
    assert calibration._reads_at_once == first.mapper.calibration._reads_at_once


@pytest.mark.slow
def test_all_maps_have_one_adjuster(demo, plain, flipped):
    atlas, adjuster = Atlas(demo.camera, Config()), AdjustAtOnce()
    atlas.adjuster.work_with(adjuster)
    front_end = FrontEnd(Config())
    for index, picture in enumerate(plain[:70] + flipped[70:72]):
        atlas.process_frame(front_end.process(Frame(index, index * PERIOD_NS, picture)))
    assert atlas.successor is not None and all(
        slam.mapper.adjustment.adjuster is atlas.adjuster for slam in (atlas.active, atlas.successor)
    )
    assert atlas.successor.times is atlas.active.times is atlas.times


@pytest.mark.slow
def test_the_image_moves_since_the_frame_before_and_not_since_the_epoch(demo, plain):
    """Which matters for a rolling shutter: after the first frame, and after a cut."""
    rolling = dataclasses.replace(demo.camera, readout_s=0.02)
    front_end, atlas, speeds = FrontEnd(Config()), Atlas(rolling, Config()), []
    for index, picture in enumerate(plain[:40] + [picture[::-1].copy() for picture in plain[40:44]]):
        atlas.process_frame(front_end.process(Frame(index, 10**18 + index * PERIOD_NS, picture)))
        speeds.append(np.linalg.norm(atlas.current.tracker.image_motion[0]))
    pixels_per_second = np.array([note.motion_px for note in atlas.notes]) / (1e-9 * PERIOD_NS)
    assert (pixels_per_second[1:3] > 10).all() and speeds[0] == speeds[40] == 0.0
    for k in (1, 2, 20, 41, 42, 43):
        assert 0.3 * pixels_per_second[k] < speeds[k] < 3 * pixels_per_second[k], k


@pytest.fixture
def lost_at_120(monkeypatch):
    """The first map loses the camera in frame 120 of a film that goes on, and finds it again from a frame in `again` on."""
    again = []
    locate = Localizer.locate

    def lose(localizer, front):
        is_first = localizer.tracker.first_id == 0 and localizer.mapper.map.frame_indices[0] < 60
        is_lost = is_first and front.frame.index >= 120 and not (again and front.frame.index >= again[0])
        if is_lost:
            localizer.lose()
        return None if is_lost else locate(localizer, front)

    monkeypatch.setattr(Localizer, "locate", lose)
    return again


@pytest.mark.slow
def test_the_next_map_begins_with_the_tracks_of_the_one_in_which_the_camera_was_lost(demo, plain, lost_at_120):
    atlas, ids = track(demo, plain)
    assert [note.state for note in atlas.notes[119:]] == [SlamState.TRACKING] * 31  # in the frame in which it was lost too
    older, newer = sorted(atlas.ranked(), key=lambda slam: slam.number)
    assert (older.number, newer.number) == (0, 1) and atlas.active is newer and atlas.left == [older]
    assert frames_of(older, 150) + frames_of(newer, 150) == list(range(150))  # what both knew is the newer one's
    assert 10 < len(older.poses) < 120 and older.map.frame_indices[-1] < newer.map.frame_indices[0]
    assert path_error(older, demo, range(150)) < 0.01 and path_error(newer, demo, range(150)) < 0.01
    assert np.isin(ids[130], ids[119]).any() and np.isin(ids[120], ids[119]).mean() > 0.8  # the tracks go on


@pytest.mark.slow
def test_a_map_that_finds_its_camera_again_goes_on_and_the_next_is_dropped_after_a_while(demo, plain, lost_at_120):
    lost_at_120.append(125)
    config = dataclasses.replace(Config(), atlas=dataclasses.replace(Config().atlas, frames_beside=12))
    front_end, atlas = FrontEnd(config), Atlas(demo.camera, config)
    for index in range(145):
        atlas.process_frame(front_end.process(Frame(index, index * PERIOD_NS, plain[index])))
        if 120 <= index < 125:
            assert atlas.current is atlas.successor and atlas.current.map.num_keyframes > 5
        else:
            assert atlas.current is atlas.active and atlas.active.number == 0
        assert (atlas.successor is not None) == (120 <= index < 125 + 12)
        assert all(slam is not atlas.successor for slam, _, _ in atlas.take_settled_keyframes())
        assert len(atlas.ranked()) == (2 if 120 <= index < 125 else 1 if index > 60 else len(atlas.ranked()))
