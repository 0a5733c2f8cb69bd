# SPDX-License-Identifier: Apache-2.0
"""What a map that grows for ever can do without: keyframes whose landmarks others see too, tracks that never became landmarks."""

from dataclasses import dataclass

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import MemoryConfig
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
    return Condensation(sparse_map.condensed(kept_keyframes, needed_ids, config.min_observations, num_recent), kept_keyframes)
