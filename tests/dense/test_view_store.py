# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.dense import view_store
from vitamin3d.dense.view_store import ViewStore, packed
from vitamin3d.types import DepthView

SHAPE = (reference.SMALL.height, reference.SMALL.width)
SIZE = 5 * SHAPE[0] * SHAPE[1]


def view(number=0, is_grey=True):
    rng = np.random.default_rng(number)
    depth = np.where(rng.uniform(size=SHAPE) < 0.2, 0.0, rng.uniform(0.5, 40.0, SHAPE)).astype(np.float32)
    weights = np.where(depth > 0, 10.0 ** rng.uniform(-3, 6, SHAPE), 0.0).astype(np.float32)
    color = rng.integers(0, 256, (*SHAPE, 1 if is_grey else 3)).astype(np.uint8)
    T, nothing = np.eye(4) * (1 + number), np.zeros((0, 0, 3), np.float32)
    return DepthView(number, T, depth, nothing, np.broadcast_to(color, (*SHAPE, 3)), weights)


@pytest.mark.parametrize("is_grey", [True, False])
def test_a_view_comes_back(is_grey):
    one = view(3, is_grey)
    small = packed(one)
    back = small.view()
    assert len(small.data) == (5 if is_grey else 7) * SHAPE[0] * SHAPE[1] and back.timestamp_ns == 3
    np.testing.assert_array_equal(back.depth == 0, one.depth == 0)
    np.testing.assert_allclose(back.depth, one.depth, rtol=1e-4)
    np.testing.assert_allclose(back.weights, one.weights, rtol=3e-4)
    np.testing.assert_array_equal(back.color, one.color)
    np.testing.assert_array_equal(back.T_cam_world, one.T_cam_world)
    assert np.log(back.depth[back.depth > 0]).min() < np.log(small.middle_depth) < np.log(back.depth.max())
    assert back.depth.dtype == back.weights.dtype == np.float32


def test_packing_what_was_packed_changes_nothing():
    once = packed(view(1)).view()
    again = packed(dataclasses.replace(once)).view()
    np.testing.assert_allclose(again.depth, once.depth, rtol=1e-6)


def test_a_view_without_depth_or_with_one_depth():
    empty = dataclasses.replace(view(), depth=np.zeros(SHAPE, np.float32))
    assert not packed(empty).view().depth.any() and not packed(empty).view().weights.any()
    flat = dataclasses.replace(view(), depth=np.full(SHAPE, 2.0, np.float32))
    np.testing.assert_allclose(packed(flat).view().depth, 2.0, rtol=1e-6)


def test_the_latest_views_are_kept_in_the_room_there_is():
    store = ViewStore(int(3.5 * SIZE))
    for number in range(5):
        store.add(packed(view(number)))
    assert [header.timestamp_ns for header in store.headers()] == [2, 3, 4] and store.num_forgotten == 2
    assert store.num_bytes == 3 * SIZE <= store.max_bytes
    for kept in store.views({2, 4}):
        np.testing.assert_array_equal(kept.depth, packed(view(kept.timestamp_ns)).view().depth)
    assert [kept.timestamp_ns for kept in store.views({2, 4, 99})] == [2, 4]
    store.close()
    assert len(store) == 0


def test_views_of_different_sizes_share_the_room():
    store, sizes = ViewStore(int(3.2 * SIZE)), {}
    for number in range(12):
        small = packed(view(number, is_grey=number % 3 > 0))
        store.add(small)
        sizes[number] = small
    kept = [header.timestamp_ns for header in store.headers()]
    assert kept == list(range(12 - len(kept), 12)) and len(kept) >= 2
    for back in store.views(set(kept)):
        np.testing.assert_array_equal(back.color, sizes[back.timestamp_ns].view().color)


def test_a_full_disk_ends_the_keeping_and_not_the_run(monkeypatch):
    class Full:
        def seek(self, at):
            pass

        def write(self, data):
            raise OSError("no space left on device")

    monkeypatch.setattr(view_store.tempfile, "TemporaryFile", lambda **_: Full())
    store = ViewStore(10 * SIZE)
    for number in range(2):
        store.add(packed(view(number)))
    assert len(store) == 0 and store.num_forgotten == 2 and "no space left" in store.failure
    tiny = ViewStore(10)
    tiny.add(packed(view()))
    assert len(tiny) == 0 and tiny.num_forgotten == 1
