# SPDX-License-Identifier: Apache-2.0
"""The two volumes of a map: what goes into them, when, and what is moved; and the surfaces that come out."""

import dataclasses

import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.config import Config, FusionConfig, RefusionConfig, SurfaceConfig
from vitamin3d.dense.volumes import Volumes
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.types import DepthView, StepTimes, Surface

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
CANVAS = reference.SMALL
GIVEN = FusionConfig(voxel_low=0.4, voxel_high=0.1, backend="blocks")


class Notebook:
    """A volume that notes what it is asked; its surface is a strip of triangles."""

    def __init__(self, voxel_length, num_triangles=30):
        self.voxel_length, self.num_triangles = voxel_length, num_triangles
        self.integrated, self.removed = [], []

    def integrate(self, view, canvas, max_depth):
        assert canvas is CANVAS
        self.integrated.append((view, max_depth))

    def remove(self, view, canvas, max_depth):
        assert canvas is CANVAS
        self.removed.append((view, max_depth))

    def size(self):
        return None

    def extract_surface(self):
        count = np.arange(self.num_triangles + 2)
        vertices = np.column_stack([count // 2, count % 2, 0 * count]).astype(float)
        triangles = np.stack([count[:-2], count[1:-1], count[2:]], axis=1).astype(np.int32)
        triangles[1::2] = triangles[1::2, ::-1]  # all of them face one way
        return Surface(vertices, triangles, np.zeros_like(vertices), np.zeros(vertices.shape, np.uint8))


def volumes_of(fusion=GIVEN, keeps_views=False, num_triangles=30, **settings):
    """Volumes of notebooks, and the notebooks in the order in which they were made."""
    made, config = [], dataclasses.replace(Config(), fusion=fusion, **settings)

    def make(voxel_length):
        made.append(Notebook(voxel_length, num_triangles))
        return made[-1]

    return Volumes(CANVAS, config, StepTimes(), keeps_views, make), made


def view_at(depth, timestamp_ns=0, T=None):
    """A wall at a depth before the camera."""
    shape = CANVAS.height, CANVAS.width
    depths, color = np.full(shape, depth, np.float32), np.full((*shape, 3), 90, np.uint8)
    T = np.eye(4) if T is None else T
    return DepthView(timestamp_ns, T, depths, np.zeros((*shape, 3), np.float32), color, np.full(shape, 50.0, np.float32))


# --- when views go in ------------------------------------------------------------------------------------------------


def test_views_wait_until_the_voxels_can_be_chosen():
    volumes, made = volumes_of(FusionConfig(keyframes_for_depth=3, depth_per_voxel_low=20.0, depth_per_voxel_high=100.0, max_depth=2.5))
    views = [view_at(depth, k) for k, depth in enumerate((2.0, 3.0, 4.0, 9.0, 9.0))]
    in_it = [[view.timestamp_ns for view in volumes.fuse(view)] for view in views[:2]]
    assert in_it == [[], []] and made == [] and volumes.low is None
    in_it = [[view.timestamp_ns for view in volumes.fuse(view)] for view in views[2:]]
    assert in_it == [[0, 1, 2], [3], [4]]
    assert [volume.voxel_length for volume in made] == pytest.approx([3.0 / 20, 3.0 / 100]) and made == [volumes.low, volumes.high]
    for volume in made:
        assert [view.timestamp_ns for view, _ in volume.integrated] == [0, 1, 2, 3, 4]
        assert [limit for _, limit in volume.integrated] == pytest.approx([7.5, 7.5, 7.5, 8.75, 10.0])  # 2.5 medians of those so far
    assert {step: len(times) for step, times in volumes.times.milliseconds.items()} == {"fusion_low": 5, "fusion_high": 5}


def test_where_the_voxels_are_given_no_view_waits():
    volumes, made = volumes_of()
    assert [view.timestamp_ns for view in volumes.fuse(view_at(3.0, 7))] == [7]
    assert [volume.voxel_length for volume in made] == [0.4, 0.1] == list(volumes.voxel_lengths())


@pytest.mark.parametrize(("low", "high", "expected"), [(0.4, None, (0.4, 0.05)), (None, 0.1, (0.25, 0.1))])
def test_where_one_of_them_is_given_the_other_follows_the_depth(low, high, expected):
    volumes, made = volumes_of(FusionConfig(voxel_low=low, voxel_high=high, keyframes_for_depth=2, depth_per_voxel_high=100.0))
    assert volumes.fuse(view_at(4.0)) == [] and len(volumes.fuse(view_at(6.0))) == 2
    assert tuple(volume.voxel_length for volume in made) == pytest.approx(expected)


def test_views_that_still_wait_go_in_when_no_more_will_come():
    volumes, made = volumes_of(FusionConfig(keyframes_for_depth=20))
    assert volumes.fuse_waiting() == [] == made
    volumes.fuse(view_at(2.0, 1))
    volumes.fuse(view_at(4.0, 2))
    assert [view.timestamp_ns for view in volumes.fuse_waiting()] == [1, 2] and volumes.fuse_waiting() == []
    assert made[0].voxel_length == pytest.approx(3.0 / 20) and len(made[0].integrated) == 2


def test_the_depth_of_the_scene_is_that_of_what_is_drawn():
    volumes, _ = volumes_of(FusionConfig(keyframes_for_depth=2))
    half = view_at(3.0)
    half.depth[:, 64:] = 0.0
    volumes.fuse(half)
    volumes.fuse(view_at(5.0))
    assert volumes.voxel_lengths() == pytest.approx((4.0 / 20, 4.0 / 120)) and volumes.median_depths == [3.0, 5.0]


@pytest.mark.parametrize("fusion", [GIVEN, FusionConfig(backend="blocks")])
def test_a_view_in_which_nothing_is_drawn_changes_nothing(fusion):
    volumes = Volumes(CANVAS, dataclasses.replace(Config(), fusion=fusion), StepTimes())
    volumes.fuse(view_at(0.0))
    volumes.fuse_waiting()
    assert all(len(surface.triangles) == 0 for surface in volumes.surfaces())


# --- views that are moved --------------------------------------------------------------------------------------------

SHIFT = exp_se3(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))


def fused(count=3, **settings):
    volumes, made = volumes_of(keeps_views=True, **settings)
    for k in range(count):
        volumes.fuse(view_at(3.0 + k, k))
    return volumes, made


def test_views_whose_keyframe_is_elsewhere_by_now_are_taken_out_and_fused_anew():
    volumes, made = fused()
    assert volumes.fuse_again({0: np.eye(4), 1: SHIFT, 2: np.eye(4)}) == 1
    for volume in made:
        ((out, limit),), (again, limit_again) = volume.removed, volume.integrated[3]
        view, limit_before = volume.integrated[1]
        assert limit == limit_again == limit_before == np.inf and len(volume.integrated) == 4
        assert out.timestamp_ns == again.timestamp_ns == 1
        for name in ("depth", "weights", "color"):
            np.testing.assert_array_equal(getattr(out, name), getattr(view, name))  # bit by bit what went in
            np.testing.assert_array_equal(getattr(again, name), getattr(view, name))
        np.testing.assert_array_equal(out.T_cam_world, np.eye(4))
        np.testing.assert_array_equal(again.T_cam_world, SHIFT)
    assert len(volumes.times.milliseconds["refusion"]) == 1


def test_views_whose_keyframe_the_map_has_given_up_go():
    volumes, made = fused()
    assert volumes.fuse_again({0: np.eye(4), 1: np.eye(4)}) == 1
    for volume in made:
        assert [view.timestamp_ns for view, _ in volume.removed] == [2] and len(volume.integrated) == 3


def test_what_moved_by_less_than_a_voxels_share_stays():
    for share, num_moved in ((1.9, 3), (2.1, 0)):  # of 0.1 of a fine voxel each: SHIFT is 0.2
        volumes, made = fused(refusion=RefusionConfig(min_motion_voxels=share))
        assert volumes.fuse_again(dict.fromkeys(range(3), SHIFT)) == num_moved
        assert len(made[0].removed) == len(made[1].removed) == num_moved


def test_a_turn_moves_what_is_far():
    turn = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.02, 0.0]))
    volumes, made = fused(refusion=RefusionConfig(min_motion_voxels=0.9))
    assert volumes.fuse_again(dict.fromkeys(range(3), turn)) == 2  # by more than 0.09 at depths of 4 and 5
    assert [view.timestamp_ns for view, _ in made[0].removed] == [1, 2]


def test_views_are_moved_once():
    volumes, made = fused()
    assert volumes.fuse_again(dict.fromkeys(range(3), SHIFT)) == 3
    assert volumes.fuse_again(dict.fromkeys(range(3), SHIFT @ SHIFT)) == 0 and len(made[0].integrated) == 6


def test_views_that_wait_are_fused_before_others_are_moved():
    volumes, made = volumes_of(FusionConfig(backend="blocks", keyframes_for_depth=9), keeps_views=True)
    volumes.fuse(view_at(3.0, 5))
    assert volumes.fuse_again({5: SHIFT}) == 1 and len(made[1].integrated) == 2
    empty, _ = volumes_of(keeps_views=True)
    assert empty.fuse_again({5: SHIFT}) == 0


@pytest.mark.parametrize(
    ("keeps_views", "fusion", "refusion"),
    [
        (False, GIVEN, RefusionConfig()),
        (True, dataclasses.replace(GIVEN, backend="scalable"), RefusionConfig()),
        (True, GIVEN, RefusionConfig(enabled=False)),
    ],
)
def test_where_views_are_not_kept_none_is_moved(keeps_views, fusion, refusion):
    volumes, made = volumes_of(fusion, keeps_views, refusion=refusion)
    view = view_at(3.0)
    volumes.fuse(view)
    assert volumes.fuse_again({0: SHIFT}) == 0 and made[0].removed == []
    np.testing.assert_array_equal(made[0].integrated[0][0].depth, view.depth)
    assert made[0].integrated[0][1] == pytest.approx(9.0)


def test_a_view_that_was_moved_lies_where_its_keyframe_is():
    """With the volumes of the settings."""
    surfaces = []
    for before in (np.eye(4), exp_se3(np.array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0]))):
        settings = {"fusion": GIVEN, "surface": SurfaceConfig(min_component_triangles=1)}
        volumes = Volumes(CANVAS, dataclasses.replace(Config(), **settings), StepTimes(), keeps_views=True)
        volumes.fuse(view_at(3.0, 0, before))
        volumes.fuse_again({0: np.eye(4)})
        surfaces.append(volumes.surfaces())
    for right, moved in zip(*surfaces, strict=True):
        assert len(right.triangles) == len(moved.triangles) > 20
        np.testing.assert_allclose(moved.vertices_world, right.vertices_world, atol=1e-6)
        assert np.abs(right.vertices_world[:, 2] - 3.0).max() < 0.05


# --- surfaces --------------------------------------------------------------------------------------------------------


def test_of_nothing_there_are_two_surfaces_of_nothing():
    for volumes in (volumes_of()[0], volumes_of(FusionConfig())[0]):
        for surface in volumes.surfaces():
            assert len(surface.vertices_world) == len(surface.triangles) == len(surface.normals_world) == len(surface.colors) == 0
        assert set(volumes.times.milliseconds) == {"surface_low", "surface_high"}


def test_pieces_of_the_same_area_are_removed_from_both_surfaces():
    for num_triangles, is_left in ((30, (True, False)), (300, (True, True)), (3, (False, False))):
        volumes, _ = volumes_of(num_triangles=num_triangles, surface=SurfaceConfig(min_component_triangles=160))  # 10 of the coarse ones
        volumes.fuse(view_at(3.0))
        assert tuple(len(surface.triangles) == num_triangles for surface in volumes.surfaces()) == is_left


def test_surfaces_have_normals():
    volumes, _ = volumes_of(surface=SurfaceConfig(min_component_triangles=1))
    volumes.fuse(view_at(3.0))
    np.testing.assert_allclose(volumes.surfaces()[1].normals_world, np.broadcast_to([0.0, 0.0, -1.0], (32, 3)))


def test_the_remark_says_what_is_not_in_the_surfaces():
    blocks, scalable = (
        volumes_of(FusionConfig(backend=name), surface=SurfaceConfig(55))[0].filter_remark for name in ("blocks", "scalable")
    )
    assert "55" in blocks and "deviation" not in blocks and "55" in scalable and f"{FusionConfig().max_relative_deviation:g}" in scalable
