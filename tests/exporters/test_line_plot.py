# SPDX-License-Identifier: Apache-2.0
"""Plots as SVG: well-formed, inside the frame, honest about gaps."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from vitamin3d.exporters.line_plot import MAX_POINTS, Axes, Line, line_plot, ticks


def parsed(lines, **options):
    return ElementTree.fromstring(line_plot(Axes("a < b", "time [s]", "error", **options), lines))


def polylines(svg):
    found = [node.get("points").split() for node in svg.iter("{http://www.w3.org/2000/svg}polyline")]
    return [np.array([place.split(",") for place in places], float) for places in found]


def test_values_are_where_the_axes_say(rng):
    x, y = np.arange(5.0), np.array([0.0, 2.0, 1.0, 4.0, 3.0])
    (places,) = polylines(parsed([Line("y", x, y)]))
    np.testing.assert_allclose(np.corrcoef(places[:, 0], x)[0, 1], 1.0, atol=1e-6)
    np.testing.assert_allclose(np.corrcoef(places[:, 1], y)[0, 1], -1.0, atol=1e-5)
    assert (places > 0).all() and (places < [640, 320]).all()


def test_equal_axes_keep_squares_square():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0.0]])
    (places,) = polylines(parsed([Line("s", *square.T)], is_equal=True))
    assert np.ptp(places[:, 0]) == pytest.approx(np.ptp(places[:, 1]), abs=0.2)


def test_nan_breaks_a_line_and_many_points_are_thinned():
    y = np.arange(10.0)
    y[4] = np.nan
    assert [len(p) for p in polylines(parsed([Line("y", np.arange(10), y)]))] == [4, 5]
    (places,) = polylines(parsed([Line("y", np.arange(10_000), np.arange(10_000.0))]))
    assert len(places) <= MAX_POINTS


@pytest.mark.parametrize("y", [np.zeros(0), np.array([np.nan, np.nan])])
def test_nothing_to_draw_is_said(y):
    assert "no data" in line_plot(Axes("t", "x", "y"), [Line("y", np.zeros(len(y)), y)])


def test_constant_and_single_values_are_drawn():
    assert len(polylines(parsed([Line("y", np.arange(3), np.full(3, 7.0))]))) == 1
    assert len(re.findall("<circle", line_plot(Axes("t", "x", "y"), [Line("y", np.array([1.0]), np.array([2.0]))]))) == 1


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3e-5, 4e-5), (99.0, 12345.0), (1e6, 1e6 + 1)])
def test_ticks_are_round_and_inside(low, high):
    found = ticks(low, high, 6)
    assert 2 <= len(found) <= 7 and low <= found[0] and found[-1] <= high * (1 + 1e-12)
    steps = np.diff(found)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-5)
    assert float(f"{steps[0]:.1e}"[0]) in (1, 2, 5)
