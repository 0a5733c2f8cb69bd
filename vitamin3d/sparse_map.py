# SPDX-License-Identifier: Apache-2.0
"""The sparse map: keyframes, landmarks and observations as growing arrays; one owner writes it.

The id of a landmark is the id of its track, given at the track's birth and never used again; the map keeps it in a row of its own
(`rows_of`), and only rows are numbered anew when the map forgets something. A track's observations are stored from its first keyframe
on; it becomes a landmark when it gets a point (`points_world` is NaN until then), and its older observations count from that moment.
"""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.growing_array import GrowingArray, IdRows
from vitamin3d.image.patches import PATCH_PX
from vitamin3d.types import Array


@kernel
def _find_mapped(points, rows, found):  # type: ignore[no-untyped-def]
    for i in range(rows.shape[0]):
        found[i] = 0 <= rows[i] < points.shape[0] and not np.isnan(points[rows[i], 0])


@kernel
def _relabel(starts, obs_landmark, obs_valid, first, new_row, is_target, count, first_new, last_new):  # type: ignore[no-untyped-def]
    """Gives observations of landmark i to new_row[i] (where >= 0) unless that has one in the same keyframe; recounts the targets.

    Observations that do not count (older than `first`) of either become invalid, so that they cannot count again.
    """
    owner = np.full(first.shape[0], -1, np.int64)
    for k in range(starts.shape[0] - 1):
        for i in range(starts[k], starts[k + 1]):
            row = obs_landmark[i]
            if is_target[row]:
                obs_valid[i] &= i >= first[row]
                if obs_valid[i]:
                    owner[row] = k
                    count[row] += 1
                    first_new[row] = i if first_new[row] < 0 else first_new[row]
                    last_new[row] = i
        for i in range(starts[k], starts[k + 1]):
            row = obs_landmark[i]
            target = new_row[row]
            if target < 0:
                continue
            obs_valid[i] &= i >= first[row] and owner[target] != k
            if obs_valid[i]:
                obs_landmark[i] = target
                owner[target] = k
                count[target] += 1
                first_new[target] = i if first_new[target] < 0 else min(i, first_new[target])
                last_new[target] = i


class SparseMap:
    """Keyframes (K), landmarks (L, by row) and observations (M, in keyframe order).

    Args:
        first_id: the least id of a track that it may come to know.
    """

    def __init__(self, first_id: int = 0) -> None:
        self._ids = IdRows(first_id)
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
        """(L, 3) by row, NaN where the track is no landmark; a view."""
        return self._points.view

    @property
    def landmarks(self) -> Array:
        """(N,) rows of those that are landmarks, ascending."""
        return np.flatnonzero(~np.isnan(self.points_world[:, 0]))

    @property
    def num_observations(self) -> Array:
        """(L,) int32 by row: valid observations in keyframes; a view."""
        return self._count.view

    @property
    def last_observation(self) -> Array:
        """(L,) index of the latest observation by row, -1 for none; a view."""
        return self._last.view

    @property
    def first_observation(self) -> Array:
        """(L,) index of the earliest observation that counts by row, -1 for none; a view."""
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
        """(M,) row of the landmark of each observation; a view."""
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

    def rows_of(self, ids: Array) -> Array:
        """(N,) rows of the tracks with these ids (N,), which may be beyond the arrays' ends; -1 for what the map has forgotten."""
        return self._ids.of(ids)

    def ids_of(self, rows: Array) -> Array:
        """(N,) ids of the tracks in these rows (N,)."""
        return self._ids.ids(rows)

    @property
    def remembered_ids(self) -> Array:
        """(I,) ascending: of what came before the map last forgot something, the ids that it still knows."""
        return self._ids.old

    def is_mapped(self, rows: Array) -> Array:
        """(N,) bool: which rows (N,) hold landmarks."""
        out = np.empty(len(rows), np.bool_)
        _find_mapped(self.points_world, rows, out)
        return out

    def mapped(self, ids: Array) -> tuple[Array, Array]:
        """(N,) bool which of the tracks with these ids (N,) are landmarks, and the rows (M,) of those."""
        rows = self.rows_of(ids)
        is_mapped = self.is_mapped(rows)
        return is_mapped, rows[is_mapped]

    def add_keyframe(
        self, frame_index: int, timestamp_ns: int, T_cam_world: Array, ids: Array, pixels: Array, colors: Array, patches: Array,
        image_motion: Array = NO_MOTION, position_deviation_deg: float = 0.0,
    ) -> int:  # fmt: skip
        """Adds a keyframe with the observations of all its tracks, landmarks or not; those whose row was forgotten are left out.

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
        start, rows = self._obs_landmark.size, self.rows_of(ids)
        if rows.min(initial=0) < 0:
            rows, pixels, colors, patches = (array[rows >= 0] for array in (rows, pixels, colors, patches))
        self.frame_indices.append(frame_index)
        self.timestamps_ns.append(timestamp_ns)
        self._poses.append(T_cam_world[None])
        self._motions.append(image_motion[None])
        self._deviations.append(np.array([position_deviation_deg]))
        self._obs_landmark.append(rows)
        self._obs_pixels.append(pixels)
        self._obs_valid.append(np.ones(len(rows), np.bool_))
        self.keyframe_starts.append(self._obs_landmark.size)
        self._touch_landmarks(rows, np.arange(start, self._obs_landmark.size), colors, patches)
        return self.num_keyframes - 1

    def _touch_landmarks(self, rows: Array, observations: Array, colors: Array, patches: Array) -> None:
        size = int(rows.max(initial=-1)) + 1
        for array in (self._points, self._first, self._last, self._count, self._colors, self._patches):
            array.resize(size)
        is_new = self._first.view[rows] < 0
        self._first.view[rows[is_new]] = observations[is_new]
        self._last.view[rows] = observations
        self._count.view[rows] += 1
        self._colors.view[rows] = colors
        self._patches.view[rows] = patches

    def remove_observations(self, observations: Array) -> None:
        """Marks observation indices as outliers; a landmark left with fewer than two loses its point."""
        observations = observations[self.obs_valid[observations]]
        self.obs_valid[observations] = False
        rows = self.obs_landmark[observations]
        rows = rows[(self.num_observations[rows] > 0) & (observations >= self.first_observation[rows])]
        np.subtract.at(self._count.view, rows, 1)
        self.remove_landmarks(np.unique(rows[self.num_observations[rows] < 2]))

    def remove_landmarks(self, rows: Array) -> None:
        """Takes the points of landmarks (N,) rows away; a track that lives on starts afresh at its next keyframe.

        Observations before `first_observation` count no more, so the old ones need not be looked for.
        """
        self._points.view[rows] = np.nan
        self._first.view[rows] = -1
        self._count.view[rows] = 0

    def merge_landmarks(self, kept: Array, gone: Array) -> None:
        """Gives the observations of landmarks in rows `gone` (N,) to `kept` (N,), all different; where both have one, kept's stays.

        The point is that of the one with more observations, the looks are the latest.
        """
        size = len(self.points_world)
        new_row, is_target = np.full(size, -1, np.int64), np.zeros(size, np.bool_)
        new_row[gone], is_target[kept] = kept, True
        better, later = self.num_observations[gone] > self.num_observations[kept], self.last_observation[gone] > self.last_observation[kept]
        self._points.view[kept[better]] = self.points_world[gone[better]]
        self._colors.view[kept[later]], self._patches.view[kept[later]] = self.colors[gone[later]], self.patches[gone[later]]
        count, first, last = np.zeros(size, np.int32), np.full(size, -1, np.int64), np.full(size, -1, np.int64)
        _relabel(
            np.array(self.keyframe_starts),
            self.obs_landmark,
            self.obs_valid,
            self.first_observation,
            new_row,
            is_target,
            count,
            first,
            last,
        )
        self._count.view[kept], self._first.view[kept], self._last.view[kept] = count[kept], first[kept], last[kept]
        self.remove_landmarks(gone)

    def condensed(self, keyframes: Array, needed_ids: Array, min_observations: int = 2, num_recent: int = 0) -> "SparseMap":
        """A copy with some keyframes only, and without what counts no more; rows and keyframes are numbered anew in their order.

        Args:
            keyframes: (K',) ascending, that stay.
            needed_ids: (N,) tracks that stay whether they are landmarks or not; may be newer than any in the map.
            min_observations: of a landmark that stays though it is neither needed nor observed in the `num_recent` newest keyframes.
        """
        size = len(self.points_world)
        stays = np.zeros(self.num_keyframes, np.bool_)
        stays[keyframes] = True
        first = self.first_observation[self.obs_landmark]
        counts = self.obs_valid & (first >= 0) & (np.arange(len(first)) >= first) & np.repeat(stays, np.diff(self.keyframe_starts))
        count = np.bincount(self.obs_landmark[counts], minlength=size)
        is_landmark = ~np.isnan(self.points_world[:, 0]) & (count >= 2)
        is_recent = self.last_observation >= self.keyframe_starts[max(0, self.num_keyframes - num_recent)]
        needed = self.rows_of(needed_ids)
        kept = np.union1d(np.flatnonzero(is_landmark & (is_recent | (count >= min_observations))), needed[needed >= 0])
        known = kept[kept < size]
        new_row = np.full(size, -1, np.int64)
        new_row[known] = np.arange(len(known))
        counts &= new_row[self.obs_landmark] >= 0
        copy = self._copy_of(keyframes, counts, new_row)
        copy._ids = self._ids.keeping(self.ids_of(kept))
        for name, array in (("_points", self._points), ("_colors", self._colors), ("_patches", self._patches)):
            getattr(copy, name).append(array.view[known])
        copy._points.view[~is_landmark[known]] = np.nan
        copy._index_observations(len(known))
        return copy

    def _copy_of(self, keyframes: Array, counts: Array, new_row: Array) -> "SparseMap":
        """Some keyframes with the observations `counts` (M,) bool, rows renumbered; no landmarks yet."""
        copy = SparseMap()
        copy.frame_indices = [self.frame_indices[k] for k in keyframes]
        copy.timestamps_ns = [self.timestamps_ns[k] for k in keyframes]
        copy._poses.append(self.T_cam_world[keyframes])
        copy._motions.append(self.image_motions[keyframes])
        copy._deviations.append(self.position_deviations_deg[keyframes])
        copy._obs_landmark.append(new_row[self.obs_landmark[counts]])
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
