# SPDX-License-Identifier: Apache-2.0
"""Every operation on eight numbers against numpy on an array of them."""

import numpy as np
import pytest

from vitamin3d._jit import kernel
from vitamin3d._simd import (
    WIDE,
    WIDTH,
    any_of,
    counting,
    counting_i16,
    gather,
    greatest,
    least,
    lesser,
    load,
    load_f32,
    load_i16,
    scatter,
    select,
    splat,
    splat_f32,
    splat_i16,
    square_root,
    store,
    total,
    total_f32,
    transposed,
    where_below,
)


@pytest.fixture
def ab(rng):
    return rng.standard_normal(WIDTH), rng.uniform(0.5, 2.0, WIDTH)


@kernel
def arithmetic(a, b, c, out):
    x, y = load(a, 0), load(b, 0)
    store(out, 0, x + y)
    store(out, WIDTH, x - y)
    store(out, 2 * WIDTH, x * y)
    store(out, 3 * WIDTH, x / y)
    store(out, 4 * WIDTH, -x)
    store(out, 5 * WIDTH, c + x * c - c / y)
    store(out, 6 * WIDTH, square_root(y))
    x += y
    x *= y
    x -= c
    store(out, 7 * WIDTH, x)
    store(out, 8 * WIDTH, splat(c))


def test_arithmetic(ab):
    (a, b), c, out = ab, 0.7, np.empty((9, WIDTH))
    arithmetic(a, b, c, out)
    expected = [a + b, a - b, a * b, a / b, -a, c + a * c - c / b, np.sqrt(b), (a + b) * b - c, np.full(WIDTH, c)]
    np.testing.assert_allclose(out, expected, rtol=1e-15, atol=1e-15)


@kernel
def choice(a, b, out):
    x, y = load(a, 0), load(b, 0)
    store(out, 0, select(x < y, x, y))
    store(out, WIDTH, select((x > 0.0) & (y <= 1.0), 1.0, 0.0))
    store(out, 2 * WIDTH, select((x >= 0.0) ^ (y > 1.0), x, 0.0))
    return any_of(x > y), any_of(x > 1e9), greatest(x), total(x)


def test_choice_and_sums(ab):
    (a, b), out = ab, np.empty((3, WIDTH))
    a[3] = np.nan
    assert choice(a, b, out)[1] == 0
    expected = [np.where(a < b, a, b), (a > 0) & (b <= 1), np.where((a >= 0) ^ (b > 1), a, 0)]
    np.testing.assert_array_equal(out, expected)
    a[3] = 0.25
    some, none, largest, added = choice(a, b, out)
    assert some == (a > b).any() and none == 0 and largest == a.max() and added == pytest.approx(a.sum(), rel=1e-14)


@kernel
def copy_every_third(table, numbers, count, out):
    for first in range(0, count, WIDTH):
        rows = counting(first)
        is_there = rows < count
        rows = select(is_there, rows, first)
        scatter(out, rows, gather(table, 3 * gather(numbers, rows) + 1))


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_gather_and_scatter(dtype, rng):
    """Arrays of any dimensions are flat ones; lanes that have nothing to do repeat the first."""
    table, numbers, out = rng.standard_normal((20, 3)), rng.integers(0, 20, 13).astype(dtype), np.full(14, -1.0)
    copy_every_third(table, numbers, 13, out)
    np.testing.assert_array_equal(out, np.append(table[numbers, 1], -1.0))


@kernel
def transpose(table, out):
    a, b, c, d = load(table, 0), load(table, 8), load(table, 16), load(table, 24)
    rows = transposed((a, b, c, d, load(table, 32), load(table, 40), load(table, 48), load(table, 56)))
    for k in range(WIDTH):
        store(out, WIDTH * k, rows[k])


def test_transposed(rng):
    table, out = rng.standard_normal((WIDTH, WIDTH)), np.empty((WIDTH, WIDTH))
    transpose(table, out)
    np.testing.assert_array_equal(out, table.T)


def test_nan_stays_nan(ab):
    (a, b), out = ab, np.empty((9, WIDTH))
    a[5], b[2] = np.nan, np.inf
    arithmetic(a, b, 1.0, out)
    assert np.isnan(out[[0, 1, 2, 3, 4, 5, 7], 5]).all() and np.isinf(out[0, 2]) and out[3, 2] == 0.0


@kernel
def with_shorts(a, b, c, out):
    x, y = load_i16(a, 1), load_i16(b, 0)
    store(out, 0, x + y - c)
    store(out, WIDE, lesser(x, y))
    store(out, 2 * WIDE, lesser(x, c))
    store(out, 3 * WIDE, where_below(x, y, counting_i16(c), splat_i16(-2)))
    return least(x), least(y)


def test_sixteen_shorts(rng):
    a, b = rng.integers(-3000, 3000, WIDE + 1).astype(np.int16), rng.integers(0, 255, WIDE).astype(np.uint8)
    out = np.empty((4, WIDE), np.int16)
    assert with_shorts(a, b, 7, out) == (a[1:].min(), b.min())
    x, y = a[1:].astype(int), b.astype(int)
    expected = [x + y - 7, np.minimum(x, y), np.minimum(x, 7), np.where(x < y, 7 + np.arange(WIDE), -2)]
    np.testing.assert_array_equal(out, expected)


@kernel
def with_singles(a, b, c, out):
    x, y = load_f32(a, 1), load_f32(b, 0)
    store(out, 0, x + y)
    store(out, WIDE, x - c)
    store(out, 2 * WIDE, c * x)
    store(out, 3 * WIDE, splat_f32(c))
    return total_f32(x)


def test_sixteen_singles(rng):
    a, b, c = rng.standard_normal(WIDE + 1).astype(np.float32), rng.integers(0, 255, WIDE).astype(np.uint8), np.float32(0.7)
    out = np.empty((4, WIDE), np.float32)
    assert with_singles(a, b, c, out) == pytest.approx(a[1:].sum(), abs=1e-5)
    np.testing.assert_allclose(out, [a[1:] + b, a[1:] - c, c * a[1:], np.full(WIDE, c)], rtol=1e-6)
