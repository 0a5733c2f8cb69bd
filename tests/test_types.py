# SPDX-License-Identifier: Apache-2.0
import numpy as np

from vitamin3d.types import Tracks


def test_tracks_are_renamed():
    zeros = np.zeros(3, np.int32)
    tracks = Tracks(np.array([7, 3, 9]), np.arange(6.0).reshape(3, 2), np.ones(3, np.float32), zeros, zeros)
    renamed = tracks.renamed(np.array([9, 7]), np.array([1, 2]))
    np.testing.assert_array_equal(renamed.ids, [2, 3, 1])
    np.testing.assert_array_equal(renamed.pixels, tracks.pixels)
    np.testing.assert_array_equal(tracks.ids, [7, 3, 9])
