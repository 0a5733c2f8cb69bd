# SPDX-License-Identifier: Apache-2.0
import pytest

from vitamin3d.dense.view_graph import ViewGraph


@pytest.mark.parametrize(("reach", "stride", "count"), [(2, 1, 7), (3, 2, 8), (1, 5, 12), (4, 3, 3), (0, 1, 4)])
def test_the_queue_gives_each_its_neighbours(reach, stride, count):
    queue: ViewGraph[int] = ViewGraph(reach, lambda k: k % stride == 0)
    ready = [around for k in range(count) for around in queue.push(k)] + queue.flush() + queue.flush()
    numbers = [(r.item, r.before, r.after) for r in ready]
    expected = [
        (k, [j for j in range(k - 1, k - reach - 1, -1) if j >= 0], [j for j in range(k + 1, k + reach + 1) if j < count])
        for k in range(0, count, stride)
    ]
    assert numbers == expected


def test_who_waited_too_long_goes_with_the_neighbours_there_are():
    queue: ViewGraph[int] = ViewGraph(3, lambda k: k % 2 == 0)
    assert [queue.push(k) for k in range(3)] == [[], [], []]
    (late,) = queue.expire(lambda item: item < 2)
    assert (late.item, late.before, late.after) == (0, [], [1, 2])
    assert queue.expire(lambda item: item < 2) == [] and queue.push(3) == [] and queue.push(4) == []
    (ready,) = queue.push(5)
    assert (ready.item, ready.before, ready.after) == (2, [1, 0], [3, 4, 5])
    assert [around.item for around in queue.expire(lambda item: True)] == [4] and queue.flush() == []
