# SPDX-License-Identifier: Apache-2.0
"""What a map that grows for ever can do without: keyframes whose landmarks others see too, tracks that never became landmarks."""

from dataclasses import dataclass

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import MemoryConfig
from vitamin3d.growing_array import IdRows
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array


@kernel
def _contributions(starts, obs_landmark, obs_valid, first, points, count, score):  # type: ignore[no-untyped-def]
    """Per keyframe the sum over its landmarks of one over the number of keyframes that observe them."""
    for k in range(score.shape[0]):
        for i in range(starts[k], starts[k + 1]):
            id_ = obs_landmark[i]
            if obs_valid[i] and i >= first[id_] and count[id_] > 0 and not np.isnan(points[id_, 0]):
                score[k] += 1.0 / count[id_]


def contributions(sparse_map: SparseMap) -> Array:
    """(K,) what each keyframe adds to the map: each of its landmarks counts one over the number of its observers."""
    score = np.zeros(sparse_map.num_keyframes)
    _contributions(
        np.array(sparse_map.keyframe_starts), sparse_map.obs_landmark, sparse_map.obs_valid, sparse_map.first_observation,
        sparse_map.points_world, sparse_map.num_observations, score,
    )  # fmt: skip
    return score


def redundant_keyframes(sparse_map: SparseMap, number: int, num_recent: int) -> Array:
    """Up to `number` keyframes, ascending, that add least; never two neighbours at once, nor the first or the `num_recent` newest."""
    last = sparse_map.num_keyframes - num_recent
    score = contributions(sparse_map)
    dropped = np.zeros(sparse_map.num_keyframes + 1, np.bool_)
    for k in np.argsort(score[1:last], kind="stable") + 1:
        if dropped.sum() == number:
            break
        dropped[k] = not (dropped[k - 1] or dropped[k + 1])
    return np.flatnonzero(dropped)


def condensed(sparse_map: SparseMap, keyframes: Array, needed_ids: Array, min_observations: int = 2, num_recent: int = 0) -> SparseMap:
    """A copy with some keyframes only, and without what counts no more; rows and keyframes are numbered anew in their order.

    Args:
        keyframes: (K',) ascending, that stay.
        needed_ids: (N,) tracks that stay whether they are landmarks or not; may be newer than any in the map.
        min_observations: of a landmark that stays though it is neither needed nor observed in the `num_recent` newest keyframes.
    """
    size = len(sparse_map.points_world)
    stays = np.zeros(sparse_map.num_keyframes, np.bool_)
    stays[keyframes] = True
    first = sparse_map.first_observation[sparse_map.obs_landmark]
    counts = sparse_map.obs_valid & (first >= 0) & (np.arange(len(first)) >= first) & np.repeat(stays, np.diff(sparse_map.keyframe_starts))
    count = np.bincount(sparse_map.obs_landmark[counts], minlength=size)
    is_landmark = ~np.isnan(sparse_map.points_world[:, 0]) & (count >= 2)
    is_recent = sparse_map.last_observation >= sparse_map.keyframe_starts[max(0, sparse_map.num_keyframes - num_recent)]
    needed = sparse_map.rows_of(needed_ids)
    kept = np.union1d(np.flatnonzero(is_landmark & (is_recent | (count >= min_observations))), needed[needed >= 0])
    known = kept[kept < size]
    new_row = np.full(size, -1, np.int64)
    new_row[known] = np.arange(len(known))
    counts &= new_row[sparse_map.obs_landmark] >= 0
    copy = _copy_of(sparse_map, keyframes, counts, new_row, sparse_map.ids.keeping(sparse_map.ids_of(kept)))
    for name in ("points_world", "colors", "patches"):
        copy.columns[name].append(sparse_map.columns[name].view[known])
    copy.points_world[~is_landmark[known]] = np.nan
    _index_observations(copy, len(known))
    return copy


def _copy_of(sparse_map: SparseMap, keyframes: Array, counts: Array, new_row: Array, ids: IdRows) -> SparseMap:
    """Some keyframes with the observations `counts` (M,) bool, rows renumbered; no landmarks yet."""
    copy = SparseMap(ids=ids)
    copy.frame_indices = [sparse_map.frame_indices[k] for k in keyframes]
    copy.timestamps_ns = [sparse_map.timestamps_ns[k] for k in keyframes]
    copy.columns["T_cam_world"].append(sparse_map.T_cam_world[keyframes])
    copy.columns["image_motions"].append(sparse_map.image_motions[keyframes])
    copy.columns["position_deviations_deg"].append(sparse_map.position_deviations_deg[keyframes])
    copy.columns["obs_landmark"].append(new_row[sparse_map.obs_landmark[counts]])
    copy.columns["obs_pixels"].append(sparse_map.obs_pixels[counts])
    copy.columns["obs_valid"].append(np.ones(int(counts.sum()), np.bool_))
    before = np.concatenate([[0], np.cumsum(counts)])[sparse_map.keyframe_starts]
    copy.keyframe_starts = [0, *np.cumsum(np.diff(before)[keyframes]).tolist()]
    return copy


def _index_observations(copy: SparseMap, size: int) -> None:
    """Counts, first and last of the observations, all of which count."""
    rows = np.arange(len(copy.obs_landmark))
    count, last, first = np.bincount(copy.obs_landmark, minlength=size), np.full(size, -1, np.int64), np.full(size, -1, np.int64)
    last[copy.obs_landmark] = rows  # of equal indices the last assignment stays
    first[copy.obs_landmark[::-1]] = rows[::-1]
    copy.columns["num_observations"].append(count.astype(np.int32))
    copy.columns["last_observation"].append(last)
    copy.columns["first_observation"].append(first)


@dataclass(frozen=True)
class Condensation:
    """A smaller map, and what became of the old one's keyframes."""

    map: SparseMap
    kept_keyframes: Array
    """(K',) old numbers, ascending."""


def is_due(sparse_map: SparseMap, num_new_ids: int, config: MemoryConfig) -> bool:
    """Whether there are too many keyframes, or tracks born since the last time."""
    return sparse_map.num_keyframes > config.max_keyframes or num_new_ids > config.max_new_tracks


def condense(sparse_map: SparseMap, needed_ids: Array, num_recent: int, config: MemoryConfig) -> Condensation:
    """The map without redundant keyframes (where there are too many) and without what no keyframe left observes.

    Args:
        needed_ids: of tracks that live, which stay whether they are landmarks or not.
        num_recent: newest keyframes that stay.
    """
    excess = sparse_map.num_keyframes - config.max_keyframes
    number = int(np.ceil(config.dropped_share * config.max_keyframes)) if excess > 0 else 0
    dropped = redundant_keyframes(sparse_map, number, num_recent) if number else np.zeros(0, np.int64)
    kept_keyframes = np.setdiff1d(np.arange(sparse_map.num_keyframes), dropped)
    return Condensation(condensed(sparse_map, kept_keyframes, needed_ids, config.min_observations, num_recent), kept_keyframes)
