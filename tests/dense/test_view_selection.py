# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from scenes import PINHOLE

from vitamin3d.config import DensificationConfig
from vitamin3d.dense.view_selection import ViewSelection, view_stride
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.types import Frame, MapSnapshot

DEPTH = 4.0


def snapshot(moved_px: float, count: int = 50) -> MapSnapshot:
    """A keyframe before a wall; the camera went sideways by so many pixels since the first one."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.full(count, DEPTH)])
    T = np.eye(4)
    T[0, 3] = moved_px * DEPTH / PINHOLE.fx
    pixels = PINHOLE.ideal_from_points(points + T[:3, 3])
    return MapSnapshot(Frame(0, 0, np.zeros((480, 640), np.uint8), None), T, pixels, np.full(count, DEPTH), np.full(count, 0.01))


def chosen(selection: ViewSelection, motions: list[float]) -> list[int]:
    return [k for k, moved in enumerate(motions) if selection.is_view(snapshot(moved))]


@pytest.mark.parametrize("stride", [1, 2, 5])
def test_where_the_camera_moves_slowly_every_so_many_th_is_a_view(stride):
    assert chosen(ViewSelection(PINHOLE, stride, 100.0), [3.0 * k for k in range(12)]) == list(range(0, 12, stride))


def test_where_it_moves_fast_views_come_sooner_and_the_count_begins_anew():
    motions = [0.0, 60.0, 120.0, 180.0, 181.0, 182.0, 183.0, 184.0, 185.0]
    assert chosen(ViewSelection(PINHOLE, 4, 100.0), motions) == [0, 2, 6]
    assert chosen(ViewSelection(PINHOLE, 4, 119.0), motions) == [0, 2, 6]
    assert chosen(ViewSelection(PINHOLE, 4, 121.0), motions) == [0, 3, 7]


def test_the_motion_is_the_median_of_the_landmarks():
    selection, first = ViewSelection(PINHOLE, 9, 100.0), snapshot(0.0)
    far = np.where(np.arange(50) < 20, 50.0 * DEPTH, DEPTH)  # these hardly move
    first = dataclasses.replace(first, depths=far)
    assert selection.is_view(first)
    assert not selection.is_view(snapshot(99.0)) and selection.is_view(snapshot(101.0))


def test_after_a_turn_that_leaves_all_behind_there_is_a_view():
    selection = ViewSelection(PINHOLE, 9, 100.0)
    assert selection.is_view(snapshot(0.0)) and not selection.is_view(snapshot(1.0))
    turned = dataclasses.replace(snapshot(0.0), T_cam_world=exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 3.0, 0.0])))
    assert selection.is_view(turned)


def test_after_a_view_without_landmarks_the_next_keyframe_is_one():
    selection = ViewSelection(PINHOLE, 9, 100.0)
    assert selection.is_view(snapshot(0.0, 0)) and selection.is_view(snapshot(1.0)) and not selection.is_view(snapshot(2.0))


def test_long_recordings_get_larger_strides_but_not_too_large_ones():
    config = DensificationConfig(keyframe_stride=2, max_views=80, max_stride=5)
    assert [view_stride(count, config) for count in (0, 10, 239, 240, 399, 400, 5000)] == [2, 2, 2, 3, 4, 5, 5]
