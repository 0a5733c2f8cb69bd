# SPDX-License-Identifier: Apache-2.0
"""From 16 bits to 8: one gain for a whole sequence, since many 16-bit pictures use a small part of their range."""

from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from vitamin3d.types import Array

FULL_RANGE = 65535
PERCENTILE = 99.5
"""Of a picture's values: hot pixels and small lamps do not count."""
WHITE = 230
"""The grey that the white level is shown as, so that what is a little brighter is not cut off."""
LARGEST_WHITE = 32768
"""From here on at least seven of the eight upper bits are in use: they are taken as they are, as in an 8-bit picture."""
BLACK = 8
"""Levels below show nothing."""
BLACK_SHARE = 1 / 64
"""Of the brightest sample's level: darker samples are black beside it."""
TYPICAL_QUANTILE = 0.75
LARGEST_EXCESS = 4
"""What a bright sample may exceed the typical ones by: flashes and windows must not darken the whole sequence."""


def white_level(samples: Iterable[Array]) -> int:
    """The 16-bit value to be shown as `WHITE`; `FULL_RANGE` where the upper bits are in use, or nothing is seen.

    The brightest sample counts, since what is cut off is lost and what is dim is not, within `LARGEST_EXCESS`.

    Args:
        samples: pictures (H, W) or (H, W, 3) uint16 of the sequence.
    """
    levels = np.array([np.percentile(pixels[::4, ::4], PERCENTILE) for pixels in samples])
    brightest = levels.max(initial=0.0)
    lit = levels[levels >= max(BLACK, BLACK_SHARE * brightest)]
    if len(lit) == 0:
        return FULL_RANGE
    white = min(brightest, LARGEST_EXCESS * np.quantile(lit, TYPICAL_QUANTILE, method="lower"))
    return round(white) if white < LARGEST_WHITE else FULL_RANGE


def eight_bits(pixels: Array, white: int = FULL_RANGE) -> Array:
    """The uint16 pixels as uint8: divided by 256, or `white` becomes `WHITE`."""
    return _table(white)[pixels]


def largest_shown(white: int) -> int:
    """The largest value that is not cut off."""
    return min(white * 255 // WHITE, FULL_RANGE)


@lru_cache(maxsize=8)
def _table(white: int) -> Array:
    values = np.arange(FULL_RANGE + 1)
    shown = values >> 8 if white == FULL_RANGE else np.minimum(np.rint(values * (WHITE / white)), 255)
    return shown.astype(np.uint8)
