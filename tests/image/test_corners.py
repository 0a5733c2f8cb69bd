# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest
from scenes import texture

from vitamin3d.image.corners import described_corners, mutual_matches


def hamming(a, b):
    """(N, K) number of bits in which descriptors differ."""
    return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)


def descriptors(count, seed):
    return np.random.default_rng(seed).integers(0, 256, (count, 32), dtype=np.uint8)


@pytest.mark.parametrize("seed", range(4))
def test_matches_are_each_others_nearest(seed):
    a, b = descriptors(90, seed), descriptors(70, 100 + seed)
    distances = hamming(a, b)
    expected = [(i, j) for i in range(90) for j in range(70) if distances[i].argmin() == j and distances[:, j].argmin() == i]
    np.testing.assert_array_equal(mutual_matches(a, b), expected)


def test_a_shuffled_copy_is_matched_row_by_row():
    a, order = descriptors(200, 0), np.random.default_rng(1).permutation(200)
    b = a[order].copy()
    b[:, :2] ^= 7  # six bits of 256
    np.testing.assert_array_equal(order[mutual_matches(a, b)[:, 1]], np.arange(200))


def test_of_two_equally_near_the_first_is_taken():
    a = descriptors(1, 0)
    np.testing.assert_array_equal(mutual_matches(a, np.concatenate([~a, a, a])), [[0, 1]])
    np.testing.assert_array_equal(mutual_matches(np.concatenate([~a, a, a]), a), [[1, 0]])


def test_a_descriptor_that_is_not_contiguous_is_read_as_it_is():
    a = descriptors(50, 3)
    np.testing.assert_array_equal(mutual_matches(a[::2], a[::2]), np.stack([np.arange(25)] * 2, axis=1))


@pytest.mark.parametrize("lengths", [(0, 5), (5, 0), (0, 0)])
def test_nothing_matches_nothing(lengths):
    assert mutual_matches(descriptors(lengths[0], 0), descriptors(lengths[1], 1)).shape == (0, 2)


def test_the_corners_of_a_turned_picture_are_the_same_ones():
    image = texture(240, 320, np.random.default_rng(5), 5.0)
    turned = cv2.rotate(image, cv2.ROTATE_180)
    (x, a), (y, b) = described_corners(image, 300), described_corners(turned, 300)
    pairs = mutual_matches(a, b)
    back = np.array([319.0, 239.0]) - y[pairs[:, 1]]
    assert (np.linalg.norm(x[pairs[:, 0]] - back, axis=1) < 2.0).mean() > 0.8
