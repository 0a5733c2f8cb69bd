# SPDX-License-Identifier: Apache-2.0
"""Keyframes find their maps' dense halves."""

from types import SimpleNamespace

import numpy as np
import pytest

from vitamin3d.config import Config
from vitamin3d.dense.stages import Chain
from vitamin3d.map_output import MapOutput, MapOutputs
from vitamin3d.scale import Scale
from vitamin3d.types import DepthView, Frame, MapSnapshot, NewestFrame, StepTimes


class Waiting:
    """A stage in which each item waits for the next one."""

    def __init__(self, made):
        self.waiting, self.made = [], made

    def push(self, item):
        self.waiting.append(self.made(item))
        yield from [self.waiting.pop(0)] if len(self.waiting) > 1 else []

    def expire(self, now_ns):
        yield from ()

    def flush(self):
        yield from self.waiting
        self.waiting = []


def view_of(snapshot):
    nothing = np.zeros((1, 1), np.float32)
    return DepthView(snapshot.frame.timestamp_ns, np.eye(4), nothing, nothing, nothing, nothing, map_number=snapshot.map_number)


class Dense:
    """A dense half of two such stages, which notes what is fused."""

    def __init__(self):
        self.densifying, self.meshing, self.fused = Waiting(lambda snapshot: snapshot), Waiting(view_of), []
        self.chain, self.volumes = Chain(self.densifying, self.meshing), self

    def fuse(self, view):
        self.fused.append((view.map_number, view.timestamp_ns))
        return []

    def add_keyframe(self, snapshot):
        return [view for view in self.chain.push(snapshot) if self.fuse(view) == []]

    def finish(self):
        return [view for view in self.chain.flush() if self.fuse(view) == []]


def snapshot(number, time_ns):
    nothing = np.zeros(0)
    return MapSnapshot(Frame(time_ns, time_ns, np.zeros((2, 2), np.uint8)), np.eye(4), np.zeros((0, 2)), nothing, nothing, number)


def outputs(threads, written):
    def begin(number):
        folder = SimpleNamespace(write_view=lambda view, scale: written.append((number, view.map_number, view.timestamp_ns)))
        made = MapOutput(None, Config(), folder, Scale(), StepTimes())
        made.reconstruction = Dense()
        return made

    return MapOutputs(begin, threads, True)


COURSE = [snapshot(0, 1), snapshot(0, 2), snapshot(3, 7), NewestFrame(8), snapshot(3, 9), snapshot(0, 10), snapshot(3, 11), snapshot(3, 12)]
"""Map 0 is found again for a moment."""


@pytest.mark.parametrize("way", ["threads", "generators", "one by one"])
def test_each_keyframe_is_fused_once_in_its_own_map_in_order(way):
    written = []
    found = outputs(way == "threads", written)
    if way == "one by one":
        for item in COURSE:
            if isinstance(item, MapSnapshot):
                found.add(item)
        found.finish()
    else:
        found.add_all(iter(COURSE))
    assert list(found.by_number) == [0, 3]
    assert found.of(0).reconstruction.fused == [(0, 1), (0, 2), (0, 10)]
    assert found.of(3).reconstruction.fused == [(3, 7), (3, 9), (3, 11), (3, 12)]
    assert [time for *_, time in written] == [1, 2, 7, 9, 10, 11, 12], "where another map's come, none waits any longer"
    assert all(at == of for at, of, _ in written)
