# SPDX-License-Identifier: Apache-2.0
import dataclasses
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from vitamin3d.atlas import Atlas
from vitamin3d.config import Config, WindowConfig
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.errors import WorkerError
from vitamin3d.run_statistics import largest_map
from vitamin3d.runtime import RunRecord, SilentObserver, median_of, run_live, run_sequential, run_threaded
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import MapSnapshot, NewestFrame, SlamState
from vitamin3d.workers import Clock

CONFIG = Config(seed=3, window=WindowConfig(keyframes=2, anchors=3))  # a small window hands keyframes over early
RUNS = {"sequential": run_sequential, "threaded": run_threaded}


@dataclasses.dataclass
class Spoilt:
    """A dataset some of whose pictures cannot be read, or whose reading fails."""

    dataset: object
    unreadable: tuple = ()
    fails_at: int = -1

    def read(self, index):
        if index == self.fails_at:
            raise RuntimeError("the disk fell off")
        return Unreadable(Path(f"{index}.png"), "spoilt") if index in self.unreadable else self.dataset.read(index)


class Watcher(SilentObserver):
    def __init__(self, stop_after=10**9):
        self.done, self.skipped, self.totals, self.stop_after = [], [], set(), stop_after

    def frame_done(self, done, total, atlas):
        self.done.append(done)
        self.totals.add(total)

    def frame_skipped(self, reason):
        self.skipped.append(reason)

    def should_stop(self):
        return len(self.done) >= self.stop_after


def run(name, dataset, camera, count=60, **options):
    """The largest map (or the one to be), and the record."""
    atlas = Atlas(camera, CONFIG)
    record = RUNS[name](dataset, range(count), FrontEnd(CONFIG), atlas, **options)
    return largest_map(atlas), record


def our_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("vitamin3d")]


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert our_threads() == []


def test_threads_change_nothing(demo):
    (a, record_a), (b, record_b) = (run(name, demo, demo.camera, 40, record=RunRecord(tracks=[])) for name in RUNS)
    assert a.map.num_keyframes >= 3 and len(a.trajectory()) > 30
    np.testing.assert_array_equal(a.trajectory().T_world_cam, b.trajectory().T_world_cam)
    np.testing.assert_array_equal(a.trajectory().timestamps_ns, b.trajectory().timestamps_ns)
    np.testing.assert_array_equal(a.map.points_world, b.map.points_world)
    np.testing.assert_array_equal(a.map.obs_pixels, b.map.obs_pixels)
    assert record_a.states == record_b.states and record_a.live_tracks == record_b.live_tracks
    for (i, ids_a, pixels_a), (j, ids_b, pixels_b) in zip(record_a.tracks, record_b.tracks, strict=True):
        assert i == j and np.array_equal(ids_a, ids_b) and np.array_equal(pixels_a, pixels_b)


@pytest.mark.slow
def test_the_dense_half_gets_each_keyframe_once_in_order_and_alike(demo):
    sinks = {name: [] for name in RUNS}
    slams = {}
    for name, received in sinks.items():
        slams[name], _ = run(name, demo, demo.camera, sink=received.append)
    a, b = sinks.values()
    frames = [snapshot.frame.index for snapshot in a]
    assert frames == slams["threaded"].map.frame_indices and len(frames) > 4
    for x, y in zip(a, b, strict=True):
        assert x.frame.index == y.frame.index
        for name in ("T_cam_world", "pixels", "depths", "relative_deviations"):
            np.testing.assert_array_equal(getattr(x, name), getattr(y, name))
    assert all(len(snapshot.depths) > 100 and (snapshot.depths > 0).all() for snapshot in a)


@pytest.mark.slow
def test_a_slow_dense_half_holds_the_map_back_and_misses_nothing(demo):
    received = []

    def slow(snapshot):
        time.sleep(0.02)
        received.append(snapshot.frame.index)

    slam, _ = run("threaded", demo, demo.camera, 80, sink=slow)
    assert received == slam.map.frame_indices


@pytest.mark.slow
@pytest.mark.parametrize("name", list(RUNS))
def test_an_exception_of_the_dense_half_comes_out(demo, name):
    def sink(snapshot):
        raise MemoryError("no room for a voxel")

    with pytest.raises(WorkerError, match=r"meshing and fusing frame \d+: MemoryError: no room") as caught:
        run(name, demo, demo.camera, sink=sink)
    assert isinstance(caught.value.__cause__, MemoryError)


@pytest.mark.slow
def test_an_exception_at_the_very_last_keyframe_comes_out(demo):
    received = []
    run("threaded", demo, demo.camera, sink=lambda snapshot: received.append(snapshot.frame.index))

    def sink(snapshot):
        if snapshot.frame.index == received[-1]:
            time.sleep(0.2)
            raise ValueError("late")

    with pytest.raises(WorkerError, match="ValueError: late"):
        run("threaded", demo, demo.camera, sink=sink)


@pytest.mark.parametrize("name", list(RUNS))
def test_an_exception_of_the_dataset_comes_out(demo, name):
    with pytest.raises(WorkerError, match="reading picture 17: RuntimeError: the disk fell off"):
        run(name, Spoilt(demo, fails_at=17), demo.camera, 30)


def test_an_exception_on_the_mapping_thread_comes_out(demo):
    class Broken(SilentObserver):
        def frame_done(self, done, total, atlas):
            if done == 12:
                raise KeyError("observer")

    with pytest.raises(KeyError, match="observer"):
        run("threaded", demo, demo.camera, 30, observer=Broken(), sink=lambda snapshot: None)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(RUNS))
def test_a_stop_keeps_what_there_is(demo, name):
    watcher, received = Watcher(stop_after=45), []
    slam, record = run(name, demo, demo.camera, 150, observer=watcher, sink=received.append)
    assert record.interrupted and record.num_frames == 150
    assert len(record.states) == len(watcher.done) == 45
    assert [snapshot.frame.index for snapshot in received] == slam.map.frame_indices and len(received) > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", list(RUNS))
def test_unreadable_frames_are_counted_and_passed_over(demo, name):
    watcher, bad = Watcher(), (0, 5, 6, 39)
    slam, record = run(name, Spoilt(demo, bad), demo.camera, 40, observer=watcher)
    assert [skipped.path.name for skipped in record.skipped] == ["0.png", "5.png", "6.png", "39.png"]
    assert watcher.skipped == record.skipped
    assert (len(record.states), record.num_frames, record.interrupted) == (36, 40, False)
    assert watcher.done == list(range(1, 41)) and watcher.totals == {40}
    assert record.states[-1] is SlamState.TRACKING and len(slam.trajectory()) > 20


@pytest.mark.parametrize("name", list(RUNS))
def test_nothing_readable_is_no_map(demo, name):
    slam, record = run(name, Spoilt(demo, tuple(range(10))), demo.camera, 10)
    assert len(record.skipped) == 10 and record.states == [] and slam.map.num_keyframes == 0
    assert len(slam.trajectory()) == 0 and slam.initializer.reason == "no frame was read"


@pytest.mark.slow
def test_the_trajectory_is_near_the_truth(demo):
    from vitamin3d.scale import match_timestamps, scale_from_ground_truth

    slam, _ = run("sequential", demo, demo.camera, 90)
    path, truth = slam.trajectory(), demo.ground_truth()
    assert len(path) > 80
    i, j = match_timestamps(path.timestamps_ns, truth.timestamps_ns)
    scale = scale_from_ground_truth(path, truth)
    steps = scale.metres_per_unit * np.linalg.norm(np.diff(path.T_world_cam[i, :3, 3], axis=0), axis=1)
    true_steps = np.linalg.norm(np.diff(truth.T_world_cam[j, :3, 3], axis=0), axis=1)
    assert 0.9 < steps.sum() / true_steps.sum() < 1.1


def test_median_of():
    assert (median_of([]), median_of([3, 1, 8])) == (0.0, 3.0)


@pytest.mark.slow
def test_live_no_frame_waits_for_a_dense_half_that_does_not_keep_up(demo):
    go, received = threading.Event(), []

    def consume(snapshots):
        go.wait(30)
        received.extend(snapshot.frame.index for snapshot in snapshots if isinstance(snapshot, MapSnapshot))

    class Opens(SilentObserver):
        def frame_done(self, done, total, atlas):
            if done == 120:
                go.set()

    atlas, record = Atlas(demo.camera, CONFIG), RunRecord()
    run_live(demo, range(120), FrontEnd(CONFIG), atlas, consume, Opens(), record)
    slam = atlas.active
    assert len(record.states) == 120 and len(slam.trajectory()) > 110
    assert record.keyframes_offered == slam.map.num_keyframes and record.keyframes_dropped > 2
    assert len(received) == record.keyframes_offered - record.keyframes_dropped
    assert set(received) <= set(slam.map.frame_indices) and received == sorted(received)


@pytest.mark.slow
@pytest.mark.parametrize("interval", [1, 3])
def test_windows_are_adjusted_at_every_so_many_keyframes(demo, interval):
    adjustment = dataclasses.replace(CONFIG.bundle_adjustment, keyframe_interval=interval)
    config = dataclasses.replace(CONFIG, bundle_adjustment=adjustment)
    atlas, adjusted = Atlas(demo.camera, config), []
    slam = atlas.active
    adjust = slam.mapper.adjustment.begin_window

    def watched(*arguments):
        adjusted.append(slam.map.num_keyframes - 1)
        adjust(*arguments)

    slam.mapper.adjustment.begin_window = watched
    run_sequential(demo, range(90), FrontEnd(config), atlas)
    assert slam is atlas.active
    assert len(adjusted) > 3 and adjusted[0] % interval == 0 and set(np.diff(adjusted)) == {interval}
    assert slam.map.num_keyframes - 1 - adjusted[-1] < interval


@pytest.mark.slow
def test_with_a_clock_windows_are_adjusted_beside_the_tracking(demo):
    at_each_keyframe = dataclasses.replace(CONFIG, bundle_adjustment=dataclasses.replace(CONFIG.bundle_adjustment, keyframe_interval=1))
    atlas, record = Atlas(demo.camera, at_each_keyframe), RunRecord()
    slam = atlas.active
    threads, solve = set(), slam.mapper.adjustment.solve

    def watched(*task):
        threads.add(threading.current_thread().name)
        time.sleep(0.4)  # longer than from keyframe to keyframe
        return solve(*task)

    slam.mapper.adjustment.solve = watched
    run_live(demo, range(90), FrontEnd(CONFIG), atlas, record=record, clock=Clock())
    assert slam is atlas.active
    assert threads == {"vitamin3d-adjustment"} and not atlas.adjuster.is_busy
    assert record.adjustments_awaited == slam.mapper.adjustment.num_awaited > 0
    reference, _ = run("sequential", demo, demo.camera, 90)
    a, b = (np.linalg.norm(np.diff(s.trajectory().T_world_cam[:, :3, 3], axis=0), axis=1).sum() for s in (slam, reference))
    assert abs(a / b - 1) < 0.05


@pytest.mark.slow
def test_without_a_clock_a_live_run_maps_like_a_sequential_one(demo):
    live, _ = run("sequential", demo, demo.camera, 60)
    atlas = Atlas(demo.camera, CONFIG)
    run_live(demo, range(60), FrontEnd(CONFIG), atlas, lambda snapshots: [time.sleep(0.05) for _ in snapshots])
    slam = atlas.active
    np.testing.assert_array_equal(slam.trajectory().T_world_cam, live.trajectory().T_world_cam)
    np.testing.assert_array_equal(slam.map.points_world, live.map.points_world)


@pytest.mark.slow
def test_live_a_dense_half_without_work_hears_how_late_it_is(demo):
    times, frames = [], []

    def consume(snapshots):
        for item in snapshots:
            is_time = isinstance(item, NewestFrame)
            (times if is_time else frames).append(item.timestamp_ns if is_time else item.frame.timestamp_ns)

    run_live(demo, range(60), FrontEnd(CONFIG), Atlas(demo.camera, CONFIG), consume)
    assert len(frames) > 2 and 10 < len(times) <= 60 and times == sorted(times)
    assert set(times) <= set(demo.timestamps_ns[:60].tolist())


@pytest.mark.slow
def test_pictures_come_when_they_are_due(demo):
    record, clock, begun = RunRecord(), Clock(), time.monotonic()
    run_live(demo, range(30), FrontEnd(CONFIG), Atlas(demo.camera, CONFIG), record=record, clock=clock)
    span = (demo.timestamps_ns[29] - demo.timestamps_ns[0]) / 1e9
    assert time.monotonic() - begun >= span
    assert [index for index, _ in record.latencies] == list(range(30)) and all(0 < seconds < 10 for _, seconds in record.latencies)


def test_a_stop_does_not_wait_for_the_next_picture(demo):
    class Rare:
        def read(self, index):
            return dataclasses.replace(demo.read(index), timestamp_ns=index * 3600 * 10**9)

    class StopsSoon(SilentObserver):
        def should_stop(self):
            raise KeyboardInterrupt

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_live(Rare(), range(3), FrontEnd(CONFIG), Atlas(demo.camera, CONFIG), observer=StopsSoon(), clock=Clock())
    assert time.monotonic() - begun < 20
