# SPDX-License-Identifier: Apache-2.0
"""Stages and chains of them: what goes in comes out later, or not at all, and in order."""

import dataclasses

import numpy as np
import pytest
import reference_dense as reference
from scenes import texture, warped

from vitamin3d.config import Config, ConsistencyConfig, DelaunayConfig, DensificationConfig
from vitamin3d.dense.depth_rendering import DepthRenderer
from vitamin3d.dense.stages import Chain, Checking, Densifying, Meshing, staged
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.types import Frame, MapSnapshot, NewestFrame, StepTimes

# --- toy stages ------------------------------------------------------------------------------------------------------


class Holding:
    """Holds so many items back, lets each out so many times (0: not at all for some), under its own name."""

    def __init__(self, name, most, patience, copies):
        self.name, self.most, self.patience, self.copies = name, most, patience, copies
        self.waiting = []

    def _named(self, count):
        out, self.waiting = self.waiting[:count], self.waiting[count:]
        for time, text in out:
            for copy in range(self.copies[time % len(self.copies)]):
                yield time, f"{text}{self.name}{copy}"

    def push(self, item):
        self.waiting.append(item)
        yield from self._named(len(self.waiting) - self.most)

    def expire(self, now_ns):
        yield from self._named(sum(now_ns - time > self.patience for time, _ in self.waiting))

    def flush(self):
        yield from self._named(len(self.waiting))

    def clear(self):
        self.waiting = []


class ByHand:
    """The stages one after the other, each list as a whole."""

    def __init__(self, stages):
        self.stages = stages

    def push(self, item):
        items = [item]
        for stage in self.stages:
            items = [out for one in items for out in stage.push(one)]
        return items

    def _closed(self, close):
        items = []
        for stage in self.stages:
            items = [*(out for one in items for out in stage.push(one)), *close(stage)]
        return items

    def expire(self, now_ns):
        return self._closed(lambda stage: stage.expire(now_ns))

    def flush(self):
        return self._closed(lambda stage: stage.flush())

    def clear(self):
        for stage in self.stages:
            stage.clear()


def random_stages(rng):
    """So many stages, and their twins."""
    settings = [
        (name, int(rng.integers(0, 4)), int(rng.integers(1, 9)), rng.integers(0, 3, int(rng.integers(1, 4))).tolist())
        for name in "abcd"[: rng.integers(0, 5)]
    ]
    return [[Holding(*setting) for setting in settings] for _ in range(2)]


@pytest.mark.parametrize("seed", range(40))
def test_a_chain_does_what_its_stages_do_one_after_the_other(seed):
    rng = np.random.default_rng(seed)
    stages, twins = random_stages(rng)
    cut = int(rng.integers(0, len(stages) + 1))
    chain, nested = Chain(*stages), Chain(Chain(*twins[:cut]), Chain(*twins[cut:]))
    by_hand, time, num_out = ByHand([Holding(t.name, t.most, t.patience, t.copies) for t in twins]), 0, 0
    for _ in range(60):
        time += int(rng.integers(0, 4))
        verb, *argument = [("push", (time, "")), ("push", (time, "")), ("expire", time), ("flush",), ("clear",)][
            rng.choice(5, p=[0.4, 0.3, 0.2, 0.07, 0.03])
        ]
        expected = by_hand.push(*argument) if verb == "push" else getattr(by_hand, verb)(*argument)
        for one in (chain, nested):
            found = getattr(one, verb)(*argument)
            assert (found if verb == "clear" else list(found)) == expected
        num_out += len(expected or [])
    assert list(chain.flush()) == list(nested.flush()) == by_hand.flush()
    assert stages == [] or num_out > 0 or any(0 in stage.copies for stage in stages)


def test_an_empty_chain_lets_everything_through():
    chain = Chain()
    assert list(chain.push("a")) == ["a"] and list(chain.expire(10**9)) == list(chain.flush()) == []
    chain.clear()


def test_what_a_stage_lets_go_late_goes_through_those_behind_it():
    chain = Chain(Holding("a", 2, 5, [1]), Holding("b", 1, 10, [1]))
    assert [list(chain.push((time, str(time)))) for time in (0, 1, 2, 3)] == [[], [], [], [(0, "0a0b0")]]
    assert list(chain.expire(8)) == [(1, "1a0b0")]  # the first stage gives 2 too, the second one keeps that
    assert list(chain.expire(13)) == [(2, "2a0b0")]
    assert list(chain.flush()) == [(3, "3a0b0")] and list(chain.flush()) == []


def test_what_was_cleared_does_not_come_out():
    chain = Chain(Holding("a", 2, 5, [1]), Holding("b", 1, 10, [1]))
    for time in range(4):
        list(chain.push((time, "")))
    chain.clear()
    assert list(chain.expire(99)) == list(chain.flush()) == []


# --- the stages of several maps --------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Item:
    """Something of a map."""

    map_number: int
    name: str


class Keeping:
    """Keeps one item back, and notes what it is asked."""

    def __init__(self, number):
        self.number, self.kept, self.asked = number, [], []

    def push(self, item):
        assert item.map_number == self.number
        self.asked.append(item.name)
        self.kept.append(item)
        yield from [self.kept.pop(0)] if len(self.kept) > 1 else []

    def expire(self, now_ns):
        self.asked.append(now_ns)
        yield from self._all() if now_ns >= 50 else []

    def flush(self):
        self.asked.append("flush")
        yield from self._all()

    def _all(self):
        kept, self.kept = self.kept, []
        return kept


def run_staged(messages):
    """Names of what comes out, and the stages."""
    stages = {}
    found = staged(messages, lambda number: stages.setdefault(number, Keeping(number)))
    return [message.timestamp_ns if isinstance(message, NewestFrame) else message.name for message in found], stages


def test_those_of_one_map_go_through_its_stage():
    out, stages = run_staged([Item(3, "a"), Item(3, "b"), Item(3, "c")])
    assert out == ["a", "b", "c"] and stages[3].asked == ["a", "b", "c", "flush"]
    assert run_staged([]) == ([], {})


def test_where_another_maps_come_those_before_wait_no_longer():
    out, stages = run_staged([Item(0, "a"), Item(0, "b"), Item(1, "c"), Item(0, "d"), Item(1, "e")])
    assert out == ["a", "b", "c", "d", "e"]
    assert stages[0].asked == ["a", "b", "flush", "d", "flush"] and stages[1].asked == ["c", "flush", "e", "flush"]


def test_the_newest_frame_goes_on_behind_what_is_late():
    out, stages = run_staged([Item(0, "a"), NewestFrame(10), Item(0, "b"), NewestFrame(60), Item(1, "c"), NewestFrame(70)])
    assert out == [10, "a", "b", 60, "c", 70]
    assert stages[0].asked == ["a", 10, "b", 60, "flush"] and stages[1].asked == ["c", 70, "flush"]


def test_two_rows_of_stages_know_how_late_it_is():
    """As in a live run, where densifying and meshing have threads of their own."""
    first, second = {}, {}
    messages = [Item(0, "a"), Item(0, "b"), NewestFrame(60), Item(0, "c"), Item(1, "d"), NewestFrame(70)]
    out = staged(staged(messages, lambda n: first.setdefault(n, Keeping(n))), lambda n: second.setdefault(n, Keeping(n)))
    assert [m.timestamp_ns if isinstance(m, NewestFrame) else m.name for m in out] == ["a", "b", 60, "c", "d", 70]
    assert 60 in second[0].asked and 70 in second[1].asked


# --- a wall before a camera that moves sideways ----------------------------------------------------------------------

DEPTH, STEP_PX = 3.0, 5
"""How far the picture moves from one keyframe to the next."""
SECOND = 10**9
CONFIG = dataclasses.replace(Config(), delaunay=DelaunayConfig(min_vertices=20))


def wall(count, landmarks=150):
    """Snapshots of a textured wall, one each second."""
    rng, camera = np.random.default_rng(11), reference.SMALL
    picture = texture(camera.height, camera.width + STEP_PX * count, rng, 1.5)
    for k in range(count):
        T = np.eye(4)
        T[0, 3] = -STEP_PX * k * DEPTH / camera.fx
        snapshot = reference.snapshot_of_plane(camera, [0, 0, 1 / DEPTH], landmarks, rng, T_cam_world=T)
        image = warped(picture, np.eye(2), np.array([-STEP_PX * k, 0.0]))[:, : camera.width]
        yield dataclasses.replace(snapshot, frame=Frame(k, k * SECOND, np.ascontiguousarray(image)))


def densifying(num_keyframes=0, **settings):
    config = dataclasses.replace(CONFIG, densification=DensificationConfig(**{"reach": 3, "keyframe_stride": 1, "planes": 10, **settings}))
    times = StepTimes()
    return Densifying(reference.SMALL, DepthRenderer(reference.SMALL, config.depth_rendering), config, times, num_keyframes), times


def times_of(items):
    """In seconds."""
    return [(item.frame if isinstance(item, MapSnapshot) else item).timestamp_ns // SECOND for item in items]


def test_keyframes_become_denser_once_their_neighbours_are_there():
    stage, times = densifying()
    snapshots = list(wall(7))
    out = [list(stage.push(snapshot)) for snapshot in snapshots]
    assert [times_of(some) for some in out] == [[], [], [], [0], [1], [2], [3]]
    late = list(stage.flush())
    assert times_of(late) == [4, 5, 6] and list(stage.flush()) == []
    for before, after in zip(snapshots, [*(one for some in out for one in some), *late], strict=True):
        count = len(before.depths)
        assert len(after.depths) > count + 150 and len(after.pixels) == len(after.relative_deviations) == len(after.depths)
        np.testing.assert_array_equal(after.depths[:count], before.depths)
        assert np.median(np.abs(after.depths[count:] / DEPTH - 1)) < 0.005 and after.frame is before.frame
    assert len(times.milliseconds["densification"]) == 7


def test_every_so_many_th_becomes_a_view():
    for settings, num_keyframes, expected in (
        ({"keyframe_stride": 3, "view_motion_px": 1e9}, 0, [0, 3, 6]),
        ({"keyframe_stride": 3, "view_motion_px": 2.0 * STEP_PX - 1}, 0, [0, 2, 4, 6]),
        ({"keyframe_stride": 2, "max_views": 10, "view_motion_px": 1e9}, 50, [0, 5]),
    ):
        stage, _ = densifying(num_keyframes, **settings)
        assert times_of([*(out for snapshot in wall(8) for out in stage.push(snapshot)), *stage.flush()]) == expected


def test_a_keyframe_waits_no_longer_than_it_may():
    stage, _ = densifying(max_wait_s=1.5)
    first, second, third = wall(3)
    assert list(stage.push(first)) == list(stage.push(second)) == list(stage.expire(3 * SECOND // 2)) == []
    assert times_of(stage.expire(3 * SECOND // 2 + 1)) == [0]
    assert times_of(stage.push(dataclasses.replace(third, frame=dataclasses.replace(third.frame, timestamp_ns=9 * SECOND)))) == [1]


def test_without_a_limit_it_waits_however_long_it_takes():
    stage, _ = densifying()
    assert list(stage.push(next(wall(1)))) == list(stage.expire(10**18)) == []


def test_keyframes_that_were_dropped_are_nobodys_neighbours():
    stage, _ = densifying()
    snapshots = list(wall(4))
    for snapshot in snapshots[:3]:
        list(stage.push(snapshot))
    stage.clear()
    list(stage.push(snapshots[3]))
    (alone,) = stage.flush()
    assert alone is snapshots[3]  # without neighbours there is nothing to add


# --- meshes ----------------------------------------------------------------------------------------------------------

NORMAL = np.array([0.06, -0.04, 0.3])


def meshing(config=CONFIG):
    renderer, times = DepthRenderer(reference.SMALL, config.depth_rendering), StepTimes()
    return Meshing(reference.SMALL, renderer, config, times), renderer.canvas, times


def test_a_keyframe_of_a_plane_becomes_a_view_of_it(rng):
    stage, canvas, times = meshing()
    T = exp_se3(np.array([0.1, 0.2, 0.0, 0.0, 0.3, 0.0]))
    snapshot = dataclasses.replace(reference.snapshot_of_plane(reference.SMALL, NORMAL, 300, rng, T_cam_world=T), map_number=4)
    (view,) = stage.push(snapshot)
    assert (view.timestamp_ns, view.map_number) == (snapshot.frame.timestamp_ns, 4)
    np.testing.assert_array_equal(view.T_cam_world, T)
    v, u = np.nonzero(view.depth)
    expected = 1.0 / (canvas.rays_from_ideal(np.column_stack([u, v]).astype(float)) @ NORMAL)
    assert (view.depth > 0).mean() > 0.9 and np.quantile(np.abs(view.depth[v, u] / expected - 1), 0.95) < 0.01
    toward = view.normals_cam[v, u] @ (-NORMAL / np.linalg.norm(NORMAL))
    assert np.median(toward) > 0.99 and (view.weights[v, u] > 0).all()
    assert set(times.milliseconds) == {"meshing", "denoising", "extrapolation", "rendering"}


def test_beyond_the_landmarks_it_ends_where_nothing_is_extrapolated(rng):
    alone = dataclasses.replace(CONFIG, extrapolation=dataclasses.replace(CONFIG.extrapolation, enabled=False))
    snapshot = reference.snapshot_of_plane(reference.SMALL, NORMAL, 300, rng)
    inner = np.abs(snapshot.pixels - [63.5, 47.5]).max(axis=1) < 40
    snapshot = dataclasses.replace(
        snapshot, pixels=snapshot.pixels[inner], depths=snapshot.depths[inner], relative_deviations=snapshot.relative_deviations[inner]
    )
    covered = [(next(meshing(config)[0].push(snapshot)).depth > 0).mean() for config in (CONFIG, alone)]
    assert 0.3 < covered[1] < covered[0] - 0.15


def test_a_keyframe_with_few_landmarks_has_no_view(rng):
    stage, _, times = meshing()
    assert list(stage.push(reference.snapshot_of_plane(reference.SMALL, NORMAL, 10, rng))) == []
    assert set(times.milliseconds) == {"meshing"}
    stage.clear()
    assert list(stage.expire(10**18)) == list(stage.flush()) == []


# --- votes -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def views():
    """Five of the wall, the third of which has depths that are a fifth too large."""
    stage, _, _ = meshing()
    found = [next(stage.push(snapshot)) for snapshot in wall(5, 300)]
    found[2] = dataclasses.replace(found[2], depth=1.2 * found[2].depth)
    return found


def checking(**settings):
    times, (_, canvas, _) = StepTimes(), meshing()
    return Checking(canvas, ConsistencyConfig(**{"first": 1, "spacing": 1, "per_side": 2, **settings}), times), times


def factors(before, after):
    return after.weights[before.weights > 0] / before.weights[before.weights > 0]


def test_a_view_that_the_others_contradict_weighs_less_and_those_that_agree_more(views):
    stage, times = checking(contradicted_weight=0.125)
    out = [*(done for view in views for done in stage.push(view)), *stage.flush()]
    assert times_of(out) == [0, 1, 2, 3, 4] and len(times.milliseconds["consistency"]) == 5
    ratios = [np.median(factors(before, after)) for before, after in zip(views, out, strict=True)]
    assert ratios == [2.0, 3.0, 0.125, 3.0, 2.0]  # one and one of two and three voters agree
    for before, after in zip(views, out, strict=True):
        np.testing.assert_array_equal(before.depth, after.depth)


def test_a_view_waits_for_its_voters_but_not_for_ever(views):
    stage, _ = checking()
    assert [times_of(stage.push(view)) for view in views[:4]] == [[], [], [0], [1]]
    assert list(stage.expire(10**18)) == [] and times_of(stage.flush()) == [2, 3]
    stage, _ = checking(max_wait_s=2.5)
    assert list(stage.push(views[0])) == list(stage.push(views[1])) == list(stage.expire(5 * SECOND // 2)) == []
    assert times_of(stage.expire(5 * SECOND // 2 + 1)) == [0] and times_of(stage.expire(4 * SECOND)) == [1]
    stage, _ = checking(max_wait_s=0.5)
    assert [times_of(stage.push(view)) for view in views[:3]] == [[], [0], [1]]


def test_a_view_alone_is_as_it_was(views):
    stage, _ = checking()
    list(stage.push(views[0]))
    stage.clear()
    list(stage.push(views[1]))
    assert [view is views[1] for view in stage.flush()] == [True]


def test_the_voters_may_be_farther_away(views):
    stage, _ = checking(first=2, spacing=2, per_side=1)
    out = [*(done for view in views for done in stage.push(view)), *stage.flush()]
    assert [np.median(factors(before, after)) for before, after in zip(views, out, strict=True)] == pytest.approx([0.1, 2.0, 0.1, 2.0, 0.1])
