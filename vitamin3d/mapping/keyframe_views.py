# SPDX-License-Identifier: Apache-2.0
"""A tracked view becomes a keyframe of the map: its tracks' pixels, colours and looks."""

import numpy as np

from vitamin3d.image.patches import cut_patches
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, Frame, TrackedView


def sample_colors(frame: Frame, pixels: Array) -> Array:
    """RGB (N, 3) uint8 of a frame at distorted pixels (N, 2), nearest."""
    at = np.rint(pixels).astype(np.int64)
    u, v = np.clip(at[:, 0], 0, frame.image.shape[1] - 1), np.clip(at[:, 1], 0, frame.image.shape[0] - 1)
    return frame.color[v, u] if frame.color is not None else np.repeat(frame.image[v, u, None], 3, axis=1)


def add_view(sparse_map: SparseMap, view: TrackedView, T_cam_world: Array, position_deviation_deg: float = 0.0) -> int:
    """Adds a tracked view as a keyframe, whose place is known to an angle at the median depth; its index."""
    colors, patches = sample_colors(view.frame, view.tracks.pixels), cut_patches(view.frame.image, view.tracks.pixels)
    frame = view.frame
    ids, pixels = view.tracks.ids, view.ideal_pixels
    return sparse_map.add_keyframe(
        frame.index, frame.timestamp_ns, T_cam_world, ids, pixels, colors, patches, view.image_motion, position_deviation_deg
    )
