# SPDX-License-Identifier: Apache-2.0
"""The sparse map: keyframes, landmarks and observations as growing arrays; one owner writes it.

The id of a landmark is the id of its track, given at the track's birth and never used again; the map keeps it in a row of its own
(`rows_of`), and only rows are numbered anew when the map forgets something. A track's observations are stored from its first keyframe
on; it becomes a landmark when it gets a point (`points_world` is NaN until then), and its older observations count from that moment.
"""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.geometry.rolling_shutter import NO_MOTION
from vitamin3d.growing_array import Column, Columns, IdRows
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


OF_TRACKS = ("points_world", "first_observation", "last_observation", "num_observations", "colors", "patches")
"""The columns that have a row for each track."""


class SparseMap(Columns):
    """Keyframes (K), landmarks (L, by row) and observations (M, in keyframe order); all arrays are views.

    Args:
        first_id: the least id of a track that it may come to know.
        ids: that it knows already, instead.
    """

    T_cam_world = Column((4, 4), np.float64, 0.0)
    """(K, 4, 4) poses of the keyframes."""
    image_motions = Column(NO_MOTION.shape, np.float64, 0.0)
    """(K, 6, 2) how the image moved when the keyframes were taken (`geometry/rolling_shutter.py`)."""
    position_deviations_deg = Column((), np.float64, 0.0)
    """(K,) how well the keyframes' places were known when they were taken, as angles at the median depth."""
    obs_landmark = Column((), np.int64, -1)
    """(M,) row of the landmark of each observation."""
    obs_pixels = Column((2,), np.float64, np.nan)
    """(M, 2) ideal pixels."""
    obs_valid = Column((), np.bool_, False)
    """(M,) bool; False: removed as an outlier."""
    points_world = Column((3,), np.float64, np.nan)
    """(L, 3), NaN where the track is no landmark."""
    first_observation = Column((), np.int64, -1)
    """(L,) index of the earliest observation that counts, -1 for none."""
    last_observation = Column((), np.int64, -1)
    """(L,) index of the latest observation, -1 for none."""
    num_observations = Column((), np.int32, 0)
    """(L,) int32 valid observations in keyframes."""
    colors = Column((3,), np.uint8, 0)
    """(L, 3) uint8 RGB of the latest observation."""
    patches = Column((PATCH_PX * PATCH_PX,), np.uint8, 0)
    """(L, 81) uint8: the 9×9 pixels around the latest observation."""

    def __init__(self, first_id: int = 0, ids: IdRows | None = None) -> None:
        super().__init__()
        self.ids = ids or IdRows(first_id)
        self.frame_indices: list[int] = []
        self.timestamps_ns: list[int] = []
        self.keyframe_starts: list[int] = [0]

    @property
    def num_keyframes(self) -> int:
        return len(self.frame_indices)

    @property
    def landmarks(self) -> Array:
        """(N,) rows of those that are landmarks, ascending."""
        return np.flatnonzero(~np.isnan(self.points_world[:, 0]))

    def keyframe_of(self, observations: Array) -> Array:
        """Keyframe of observation indices (N,)."""
        return np.asarray(np.searchsorted(self.keyframe_starts, observations, side="right") - 1)

    def observations_of(self, keyframe: int) -> slice:
        """The observations of a keyframe, as a slice of the `obs_` arrays."""
        return slice(self.keyframe_starts[keyframe], self.keyframe_starts[keyframe + 1])

    def rows_of(self, ids: Array) -> Array:
        """(N,) rows of the tracks with these ids (N,), which may be beyond the arrays' ends; -1 for what the map has forgotten."""
        return self.ids.of(ids)

    def ids_of(self, rows: Array) -> Array:
        """(N,) ids of the tracks in these rows (N,)."""
        return self.ids.ids(rows)

    @property
    def remembered_ids(self) -> Array:
        """(I,) ascending: of what came before the map last forgot something, the ids that it still knows."""
        return self.ids.old

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
        start, rows = len(self.obs_landmark), self.rows_of(ids)
        if rows.min(initial=0) < 0:
            rows, pixels, colors, patches = (array[rows >= 0] for array in (rows, pixels, colors, patches))
        self.frame_indices.append(frame_index)
        self.timestamps_ns.append(timestamp_ns)
        self.columns["T_cam_world"].append(T_cam_world[None])
        self.columns["image_motions"].append(image_motion[None])
        self.columns["position_deviations_deg"].append(np.array([position_deviation_deg]))
        self.columns["obs_landmark"].append(rows)
        self.columns["obs_pixels"].append(pixels)
        self.columns["obs_valid"].append(np.ones(len(rows), np.bool_))
        self.keyframe_starts.append(len(self.obs_landmark))
        self._touch_landmarks(rows, np.arange(start, len(self.obs_landmark)), colors, patches)
        return self.num_keyframes - 1

    def _touch_landmarks(self, rows: Array, observations: Array, colors: Array, patches: Array) -> None:
        size = int(rows.max(initial=-1)) + 1
        for name in OF_TRACKS:
            self.columns[name].resize(size)
        is_new = self.first_observation[rows] < 0
        self.first_observation[rows[is_new]] = observations[is_new]
        self.last_observation[rows] = observations
        self.num_observations[rows] += 1
        self.colors[rows] = colors
        self.patches[rows] = patches

    def remove_observations(self, observations: Array) -> None:
        """Marks observation indices as outliers; a landmark left with fewer than two loses its point."""
        observations = observations[self.obs_valid[observations]]
        self.obs_valid[observations] = False
        rows = self.obs_landmark[observations]
        rows = rows[(self.num_observations[rows] > 0) & (observations >= self.first_observation[rows])]
        np.subtract.at(self.num_observations, rows, 1)
        self.remove_landmarks(np.unique(rows[self.num_observations[rows] < 2]))

    def remove_landmarks(self, rows: Array) -> None:
        """Takes the points of landmarks (N,) rows away; a track that lives on starts afresh at its next keyframe.

        Observations before `first_observation` count no more, so the old ones need not be looked for.
        """
        self.points_world[rows] = np.nan
        self.first_observation[rows] = -1
        self.num_observations[rows] = 0

    def merge_landmarks(self, kept: Array, gone: Array) -> None:
        """Gives the observations of landmarks in rows `gone` (N,) to `kept` (N,), all different; where both have one, kept's stays.

        The point is that of the one with more observations, the looks are the latest.
        """
        size = len(self.points_world)
        new_row, is_target = np.full(size, -1, np.int64), np.zeros(size, np.bool_)
        new_row[gone], is_target[kept] = kept, True
        better, later = self.num_observations[gone] > self.num_observations[kept], self.last_observation[gone] > self.last_observation[kept]
        self.points_world[kept[better]] = self.points_world[gone[better]]
        self.colors[kept[later]], self.patches[kept[later]] = self.colors[gone[later]], self.patches[gone[later]]
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
        self.num_observations[kept], self.first_observation[kept], self.last_observation[kept] = count[kept], first[kept], last[kept]
        self.remove_landmarks(gone)

    def clone_pose(self, keyframe: int) -> Array:
        """T_cam_world (4, 4) of a keyframe, a copy."""
        return np.array(self.T_cam_world[keyframe])
