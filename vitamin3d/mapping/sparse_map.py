# SPDX-License-Identifier: Apache-2.0
"""The sparse map: keyframes, landmarks and observations as growing arrays; one owner writes it.

The id of a landmark is the id of its track, given at the track's birth. A track's observations are stored from its
first keyframe on; it becomes a landmark when it gets a point (`points_world` is NaN until then), and its older
observations count from that moment.
"""

from typing import Any

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.types import Array

PATCH_PX = 9


@kernel
def _find_mapped(points, ids, found):  # type: ignore[no-untyped-def]
    for i in range(ids.shape[0]):
        found[i] = ids[i] < points.shape[0] and not np.isnan(points[ids[i], 0])


@kernel
def _relabel(starts, obs_landmark, obs_valid, first, new_id, is_target, count, first_new, last_new):  # type: ignore[no-untyped-def]
    """Gives observations of landmark i to new_id[i] (where >= 0) unless that has one in the same keyframe; recounts the targets.

    Observations that do not count (older than `first`) of either become invalid, so that they cannot count again.
    """
    owner = np.full(first.shape[0], -1, np.int64)
    for k in range(starts.shape[0] - 1):
        for i in range(starts[k], starts[k + 1]):
            id_ = obs_landmark[i]
            if is_target[id_]:
                obs_valid[i] &= i >= first[id_]
                if obs_valid[i]:
                    owner[id_] = k
                    count[id_] += 1
                    first_new[id_] = i if first_new[id_] < 0 else first_new[id_]
                    last_new[id_] = i
        for i in range(starts[k], starts[k + 1]):
            id_ = obs_landmark[i]
            target = new_id[id_]
            if target < 0:
                continue
            obs_valid[i] &= i >= first[id_] and owner[target] != k
            if obs_valid[i]:
                obs_landmark[i] = target
                owner[target] = k
                count[target] += 1
                first_new[target] = i if first_new[target] < 0 else min(i, first_new[target])
                last_new[target] = i


class GrowingArray:
    """An array whose first axis grows by doubling; `view` is the used part."""

    def __init__(self, shape: tuple[int, ...], dtype: type, fill: float) -> None:
        self._fill = fill
        self._data = self._filled((1024, *shape), dtype)
        self.size = 0

    def _filled(self, shape: tuple[int, ...], dtype: Any) -> Array:
        return np.full(shape, self._fill, dtype) if self._fill else np.zeros(shape, dtype)  # zeros cost nothing until they are used

    @property
    def view(self) -> Array:
        return self._data[: self.size]

    def resize(self, size: int) -> None:
        if size > len(self._data):
            grown = self._filled((max(size, 2 * len(self._data)), *self._data.shape[1:]), self._data.dtype)
            grown[: self.size] = self._data[: self.size]
            self._data = grown
        self.size = max(self.size, size)

    def append(self, values: Array) -> None:
        start = self.size
        self.resize(start + len(values))
        self._data[start : self.size] = values


class SparseMap:
    """Keyframes (K), landmarks (L, by id) and observations (M, in keyframe order)."""

    def __init__(self) -> None:
        self.frame_indices: list[int] = []
        self.timestamps_ns: list[int] = []
        self.keyframe_starts: list[int] = [0]
        self._poses = GrowingArray((4, 4), np.float64, 0.0)
        self._motions = GrowingArray(NO_MOTION.shape, np.float64, 0.0)
        self._deviations = GrowingArray((), np.float64, 0.0)
        self._obs_landmark = GrowingArray((), np.int64, -1)
        self._obs_pixels = GrowingArray((2,), np.float64, np.nan)
        self._obs_valid = GrowingArray((), np.bool_, False)
        self._points = GrowingArray((3,), np.float64, np.nan)
        self._first = GrowingArray((), np.int64, -1)
        self._last = GrowingArray((), np.int64, -1)
        self._count = GrowingArray((), np.int32, 0)
        self._colors = GrowingArray((3,), np.uint8, 0)
        self._patches = GrowingArray((PATCH_PX * PATCH_PX,), np.uint8, 0)

    @property
    def num_keyframes(self) -> int:
        return len(self.frame_indices)

    @property
    def T_cam_world(self) -> Array:
        """(K, 4, 4) poses of the keyframes; a view."""
        return self._poses.view

    @property
    def image_motions(self) -> Array:
        """(K, 6, 2) how the image moved when the keyframes were taken (`geometry/rolling_shutter.py`); a view."""
        return self._motions.view

    @property
    def position_deviations_deg(self) -> Array:
        """(K,) how well the keyframes' places were known when they were taken, as angles at the median depth; a view."""
        return self._deviations.view

    @property
    def points_world(self) -> Array:
        """(L, 3) by landmark id, NaN where the track is no landmark; a view."""
        return self._points.view

    @property
    def num_observations(self) -> Array:
        """(L,) int32 by landmark id: valid observations in keyframes; a view."""
        return self._count.view

    @property
    def last_observation(self) -> Array:
        """(L,) index of the latest observation by landmark id, -1 for none; a view."""
        return self._last.view

    @property
    def first_observation(self) -> Array:
        """(L,) index of the earliest observation that counts by landmark id, -1 for none; a view."""
        return self._first.view

    @property
    def patches(self) -> Array:
        """(L, 81) uint8: the 9×9 pixels around the latest observation; a view."""
        return self._patches.view

    @property
    def colors(self) -> Array:
        """(L, 3) uint8 RGB of the latest observation; a view."""
        return self._colors.view

    @property
    def obs_landmark(self) -> Array:
        """(M,) landmark id of each observation; a view."""
        return self._obs_landmark.view

    @property
    def obs_pixels(self) -> Array:
        """(M, 2) ideal pixels; a view."""
        return self._obs_pixels.view

    @property
    def obs_valid(self) -> Array:
        """(M,) bool; False: removed as an outlier; a view."""
        return self._obs_valid.view

    @property
    def obs_keyframe(self) -> Array:
        """(M,) keyframe of each observation."""
        return np.repeat(np.arange(self.num_keyframes), np.diff(self.keyframe_starts))

    def keyframe_of(self, observations: Array) -> Array:
        """Keyframe of observation indices (N,)."""
        return np.asarray(np.searchsorted(self.keyframe_starts, observations, side="right") - 1)

    def observations_of(self, keyframe: int) -> slice:
        """The observations of a keyframe, as a slice of the `obs_` arrays."""
        return slice(self.keyframe_starts[keyframe], self.keyframe_starts[keyframe + 1])

    def is_mapped(self, ids: Array) -> Array:
        """(N,) bool: which track ids (N,) are landmarks."""
        out = np.empty(len(ids), np.bool_)
        _find_mapped(self.points_world, ids, out)
        return out

    def add_keyframe(
        self, frame_index: int, timestamp_ns: int, T_cam_world: Array, ids: Array, pixels: Array, colors: Array, patches: Array,
        image_motion: Array = NO_MOTION, position_deviation_deg: float = 0.0,
    ) -> int:  # fmt: skip
        """Adds a keyframe with the observations of all its tracks, landmarks or not.

        Args:
            T_cam_world: (4, 4).
            ids: (N,) track ids.
            pixels: (N, 2) ideal pixels.
            colors: (N, 3) uint8.
            patches: (N, 81) uint8.
            image_motion: (6, 2).
            position_deviation_deg: of the camera's place, as the angle that it makes up at the median depth.

        Returns:
            The index of the keyframe.
        """
        start = self._obs_landmark.size
        self.frame_indices.append(frame_index)
        self.timestamps_ns.append(timestamp_ns)
        self._poses.append(T_cam_world[None])
        self._motions.append(image_motion[None])
        self._deviations.append(np.array([position_deviation_deg]))
        self._obs_landmark.append(ids)
        self._obs_pixels.append(pixels)
        self._obs_valid.append(np.ones(len(ids), np.bool_))
        self.keyframe_starts.append(self._obs_landmark.size)
        self._touch_landmarks(ids, np.arange(start, self._obs_landmark.size), colors, patches)
        return self.num_keyframes - 1

    def _touch_landmarks(self, ids: Array, observations: Array, colors: Array, patches: Array) -> None:
        size = int(ids.max(initial=-1)) + 1
        for array in (self._points, self._first, self._last, self._count, self._colors, self._patches):
            array.resize(size)
        is_new = self._first.view[ids] < 0
        self._first.view[ids[is_new]] = observations[is_new]
        self._last.view[ids] = observations
        self._count.view[ids] += 1
        self._colors.view[ids] = colors
        self._patches.view[ids] = patches

    def remove_observations(self, observations: Array) -> None:
        """Marks observation indices as outliers; a landmark left with fewer than two loses its point."""
        observations = observations[self.obs_valid[observations]]
        self.obs_valid[observations] = False
        ids = self.obs_landmark[observations]
        ids = ids[(self.num_observations[ids] > 0) & (observations >= self.first_observation[ids])]
        np.subtract.at(self._count.view, ids, 1)
        self.remove_landmarks(np.unique(ids[self.num_observations[ids] < 2]))

    def remove_landmarks(self, ids: Array) -> None:
        """Takes the points of landmarks away; a track that lives on starts afresh at its next keyframe.

        Observations before `first_observation` count no more, so the old ones need not be looked for.
        """
        self._points.view[ids] = np.nan
        self._first.view[ids] = -1
        self._count.view[ids] = 0

    def merge_landmarks(self, kept: Array, gone: Array) -> None:
        """Gives the observations of landmarks `gone` (N,) to `kept` (N,), all different; where both have one, kept's stays.

        The point is that of the one with more observations, the looks are the latest.
        """
        size = len(self.points_world)
        new_id, is_target = np.full(size, -1, np.int64), np.zeros(size, np.bool_)
        new_id[gone], is_target[kept] = kept, True
        better, later = self.num_observations[gone] > self.num_observations[kept], self.last_observation[gone] > self.last_observation[kept]
        self._points.view[kept[better]] = self.points_world[gone[better]]
        self._colors.view[kept[later]], self._patches.view[kept[later]] = self.colors[gone[later]], self.patches[gone[later]]
        count, first, last = np.zeros(size, np.int32), np.full(size, -1, np.int64), np.full(size, -1, np.int64)
        _relabel(
            np.array(self.keyframe_starts), self.obs_landmark, self.obs_valid, self.first_observation, new_id, is_target, count, first, last
        )
        self._count.view[kept], self._first.view[kept], self._last.view[kept] = count[kept], first[kept], last[kept]
        self.remove_landmarks(gone)

    def condensed(self, keyframes: Array, needed_ids: Array, min_observations: int = 2, num_recent: int = 0) -> tuple["SparseMap", Array]:
        """A copy with some keyframes only, and without what counts no more; ids and keyframes are numbered anew in their order.

        Args:
            keyframes: (K',) ascending, that stay.
            needed_ids: (N,) tracks that stay whether they are landmarks or not; may be larger than any in the map.
            min_observations: of a landmark that stays though it is neither needed nor observed in the `num_recent` newest keyframes.

        Returns:
            The copy, and (I',) the old ids that have new ones, ascending; the new id is the position.
        """
        size = len(self.points_world)
        stays = np.zeros(self.num_keyframes, np.bool_)
        stays[keyframes] = True
        first = self.first_observation[self.obs_landmark]
        counts = self.obs_valid & (first >= 0) & (np.arange(len(first)) >= first) & np.repeat(stays, np.diff(self.keyframe_starts))
        count = np.bincount(self.obs_landmark[counts], minlength=size)
        is_landmark = ~np.isnan(self.points_world[:, 0]) & (count >= 2)
        is_recent = self.last_observation >= self.keyframe_starts[max(0, self.num_keyframes - num_recent)]
        kept = np.union1d(np.flatnonzero(is_landmark & (is_recent | (count >= min_observations))), needed_ids)
        known = kept[kept < size]
        new_id = np.full(size, -1, np.int64)
        new_id[known] = np.arange(len(known))
        counts &= new_id[self.obs_landmark] >= 0
        copy = self._copy_of(keyframes, counts, new_id)
        for name, array in (("_points", self._points), ("_colors", self._colors), ("_patches", self._patches)):
            getattr(copy, name).append(array.view[known])
        copy._points.view[~is_landmark[known]] = np.nan
        copy._index_observations(len(known))
        return copy, kept

    def _copy_of(self, keyframes: Array, counts: Array, new_id: Array) -> "SparseMap":
        """Some keyframes with the observations `counts` (M,) bool, ids renamed; no landmarks yet."""
        copy = SparseMap()
        copy.frame_indices = [self.frame_indices[k] for k in keyframes]
        copy.timestamps_ns = [self.timestamps_ns[k] for k in keyframes]
        copy._poses.append(self.T_cam_world[keyframes])
        copy._motions.append(self.image_motions[keyframes])
        copy._deviations.append(self.position_deviations_deg[keyframes])
        copy._obs_landmark.append(new_id[self.obs_landmark[counts]])
        copy._obs_pixels.append(self.obs_pixels[counts])
        copy._obs_valid.append(np.ones(int(counts.sum()), np.bool_))
        before = np.concatenate([[0], np.cumsum(counts)])[self.keyframe_starts]
        copy.keyframe_starts = [0, *np.cumsum(np.diff(before)[keyframes]).tolist()]
        return copy

    def _index_observations(self, size: int) -> None:
        """Counts, first and last of the observations, all of which count."""
        rows = np.arange(len(self.obs_landmark))
        count, last, first = np.bincount(self.obs_landmark, minlength=size), np.full(size, -1, np.int64), np.full(size, -1, np.int64)
        last[self.obs_landmark] = rows  # of equal indices the last assignment stays
        first[self.obs_landmark[::-1]] = rows[::-1]
        self._count.append(count.astype(np.int32))
        self._last.append(last)
        self._first.append(first)

    def clone_pose(self, keyframe: int) -> Array:
        """T_cam_world (4, 4) of a keyframe, a copy."""
        return np.array(self._poses.view[keyframe])
