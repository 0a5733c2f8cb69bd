# SPDX-License-Identifier: Apache-2.0
"""Keyframes find their maps' dense halves, and files their maps' folders."""

from types import SimpleNamespace

import numpy as np
import pytest

from vitamin3d.config import Config
from vitamin3d.errors import OutputError
from vitamin3d.exporters.output_folder import OutputFolder
from vitamin3d.map_output import MapOutput, MapOutputs
from vitamin3d.scale import Scale
from vitamin3d.types import Frame, MapSnapshot, NewestFrame, StepTimes


class Waiting:
    """A dense half in which each keyframe waits for the next one, twice."""

    def __init__(self):
        self.keyframes, self.drawn, self.fused = [], [], []

    def _next(self, queue, new):
        queue += [new]
        return [queue.pop(0)] if len(queue) > 1 else []

    def _rest(self, queue):
        rest, queue[:] = list(queue), []
        return rest

    def densified_ready(self, snapshot):
        yield from self._next(self.keyframes, snapshot)

    def late_densified(self, now_ns):
        yield from ()

    def last_densified(self):
        yield from self._rest(self.keyframes)

    def drawn_ready(self, snapshot):
        yield from self._next(self.drawn, SimpleNamespace(timestamp_ns=snapshot.frame.timestamp_ns, number=snapshot.map_number))

    def late_drawn(self, now_ns):
        yield from ()

    def last_drawn(self):
        yield from self._rest(self.drawn)

    def fuse(self, view):
        self.fused.append((view.number, view.timestamp_ns))
        return []

    def add_keyframe(self, snapshot):
        views = [view for dense in self.densified_ready(snapshot) for view in self.drawn_ready(dense)]
        return [view for view in views if self.fuse(view) == []]

    def finish(self):
        views = [view for dense in self.last_densified() for view in self.drawn_ready(dense)] + list(self.last_drawn())
        return [view for view in views if self.fuse(view) == []]


def snapshot(number, time_ns):
    nothing = np.zeros(0)
    return MapSnapshot(Frame(time_ns, time_ns, np.zeros((2, 2), np.uint8)), np.eye(4), np.zeros((0, 2)), nothing, nothing, number)


def outputs(threads, written):
    def begin(number):
        folder = SimpleNamespace(write_view=lambda view, scale: written.append((number, view.number, view.timestamp_ns)))
        made = MapOutput(None, Config(), folder, Scale(), StepTimes())
        made.reconstruction = Waiting()
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


# --- folders ---------------------------------------------------------------------------------------------------------


def with_views(output, number):
    folder = output.map_folder(number)
    for name in ("depth", "normals"):
        (folder.path / name).mkdir()
        (folder.path / name / f"{number}.png").write_text(str(number))
    return folder


@pytest.mark.parametrize("ranks", [[2, 1], [1, 2, 3], [3, 1, 2], [None, 1], [2, None, 1], [None]])
def test_folders_are_put_in_the_order_of_size(tmp_path, ranks):
    output = OutputFolder(tmp_path)
    folders = [with_views(output, number) for number in range(1, len(ranks) + 1)]
    output.arrange(folders, ranks)
    for birth, rank in enumerate(ranks, 1):
        for name in ("depth", "normals"):
            places = [path.parents[1] for path in tmp_path.rglob(f"{name}/{birth}.png")]
            assert places == ([] if rank is None else [output.map_folder(rank).path])
    there = [rank for rank in ranks if rank not in (None, 1)]
    assert sorted(path.name for path in tmp_path.glob("maps/*")) == sorted(map(str, there))
    assert (tmp_path / "maps").exists() is bool(there)


def test_a_map_without_views_is_no_obstacle(tmp_path):
    output = OutputFolder(tmp_path)
    output.arrange([output.map_folder(1), with_views(output, 2)], [2, 1])
    assert (tmp_path / "depth" / "2.png").exists() and (tmp_path / "maps" / "2").is_dir()


def test_maps_of_an_earlier_run_are_refused_or_removed(tmp_path):
    OutputFolder(tmp_path).map_folder(2)
    with pytest.raises(OutputError, match=r"already holds a result \(maps\)"):
        OutputFolder(tmp_path)
    OutputFolder(tmp_path, overwrite=True)
    assert not (tmp_path / "maps").exists()
