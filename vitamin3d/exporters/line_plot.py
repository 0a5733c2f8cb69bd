# SPDX-License-Identifier: Apache-2.0
"""Line plots as SVG text: small, sharp, and they need neither a library nor a network to be seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from math import ceil, floor, log10

import numpy as np

from vitamin3d.types import Array

PALETTE = ("#1f6feb", "#d1242f", "#1a7f37", "#9a6700", "#8250df", "#57606a")
MAX_POINTS = 1500
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 34, 46


@dataclass(frozen=True)
class Line:
    """A line of a plot; NaN breaks it."""

    name: str
    x: Array
    y: Array
    color: str = ""
    """Of CSS; empty: the next of the palette."""
    is_dashed: bool = False


@dataclass(frozen=True)
class Axes:
    """What a plot shows and how large it is."""

    title: str
    x_label: str
    y_label: str
    width: int = 640
    height: int = 320
    is_equal: bool = False
    """One unit is as long across as up: for maps."""
    from_zero: bool = False
    """The vertical axis starts at zero."""


def line_plot(axes: Axes, lines: Sequence[Line]) -> str:
    """The plot as SVG; a line of one place becomes a dot, a plot of nothing says so."""
    colored = [Line(n.name, *_thinned(n.x, n.y), n.color or PALETTE[k % len(PALETTE)], n.is_dashed) for k, n in enumerate(lines)]
    limits = _limits(axes, colored)
    if limits is None:
        return _svg(axes, [_text(axes.width / 2, axes.height / 2, "no data", "middle")])
    frame = _Frame(axes, limits)
    return _svg(axes, [*frame.grid(), *(part for line in colored for part in frame.path(line)), *frame.legend(colored)])


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    keep = slice(None) if len(x) <= MAX_POINTS else np.unique(np.linspace(0, len(x) - 1, MAX_POINTS).astype(int))
    return x[keep], y[keep]


def _limits(axes: Axes, lines: Sequence[Line]) -> tuple[float, float, float, float] | None:
    """x and y ranges with some air; None without a finite point."""
    good = [np.isfinite(line.x) & np.isfinite(line.y) for line in lines]
    xs = np.concatenate([line.x[g] for line, g in zip(lines, good, strict=True)] or [np.zeros(0)])
    ys = np.concatenate([line.y[g] for line, g in zip(lines, good, strict=True)] or [np.zeros(0)])
    if len(xs) == 0:
        return None
    x0, x1 = _widened(float(xs.min()), float(xs.max()), 0.02)
    y0, y1 = _widened(float(ys.min()), float(ys.max()), 0.06)
    y0 = 0.0 if axes.from_zero else y0
    if axes.is_equal:
        per_pixel = max((x1 - x0) / (axes.width - LEFT - RIGHT), (y1 - y0) / (axes.height - TOP - BOTTOM))
        half_x, half_y = per_pixel * (axes.width - LEFT - RIGHT) / 2, per_pixel * (axes.height - TOP - BOTTOM) / 2
        x0, x1, y0, y1 = (x0 + x1) / 2 - half_x, (x0 + x1) / 2 + half_x, (y0 + y1) / 2 - half_y, (y0 + y1) / 2 + half_y
    return x0, x1, y0, y1


def _widened(low: float, high: float, share: float) -> tuple[float, float]:
    air = share * (high - low) if high > low else 0.5 * abs(high) or 0.5
    return low - air, high + air


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers between two limits, `most` of them or fewer: steps of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / max(1, most)
    power = 10.0 ** floor(log10(rough))
    step = next(s * power for s in (1.0, 2.0, 5.0, 10.0) if s * power >= rough * (1 - 1e-9))
    return [round(k * step, 12) for k in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)]


class _Frame:
    """The drawing area and the map from data to pixels."""

    def __init__(self, axes: Axes, limits: tuple[float, float, float, float]) -> None:
        self.axes, (self.x0, self.x1, self.y0, self.y1) = axes, limits
        self.right, self.bottom = axes.width - RIGHT, axes.height - BOTTOM

    def u(self, x: float) -> float:
        return LEFT + (x - self.x0) / (self.x1 - self.x0) * (self.right - LEFT)

    def v(self, y: float) -> float:
        return self.bottom - (y - self.y0) / (self.y1 - self.y0) * (self.bottom - TOP)

    def grid(self) -> list[str]:
        parts = []
        for x in ticks(self.x0, self.x1, 8):
            parts += [
                f'<path class="g" d="M{self.u(x):.1f} {TOP}V{self.bottom}"/>',
                _text(self.u(x), self.bottom + 16, f"{x:.6g}", "middle"),
            ]
        for y in ticks(self.y0, self.y1, 6):
            parts += [f'<path class="g" d="M{LEFT} {self.v(y):.1f}H{self.right}"/>', _text(LEFT - 6, self.v(y) + 4, f"{y:.6g}", "end")]
        middle = (TOP + self.bottom) / 2
        turned = (
            f'<text x="14" y="{middle:.0f}" text-anchor="middle" transform="rotate(-90 14 {middle:.0f})">{escape(self.axes.y_label)}</text>'
        )
        return [*parts, _text((LEFT + self.right) / 2, self.axes.height - 10, self.axes.x_label, "middle"), turned]

    def path(self, line: Line) -> list[str]:
        dash = ' stroke-dasharray="5 4"' if line.is_dashed else ""
        parts = []
        for x, y in _runs(line.x, line.y):
            if len(x) == 1:
                parts.append(f'<circle cx="{self.u(x[0]):.1f}" cy="{self.v(y[0]):.1f}" r="3" fill="{line.color}"/>')
            else:
                places = " ".join(f"{self.u(a):.1f},{self.v(b):.1f}" for a, b in zip(x, y, strict=True))
                parts.append(f'<polyline points="{places}" fill="none" stroke="{line.color}" stroke-width="1.4"{dash}/>')
        return parts

    def legend(self, lines: Sequence[Line]) -> list[str]:
        parts, u = [], float(LEFT)
        for line in lines if len(lines) > 1 else []:
            parts.append(f'<path d="M{u:.0f} 26h16" stroke="{line.color}" stroke-width="3"/>')
            parts.append(_text(u + 20, 30, line.name, "start"))
            u += 34 + 6.4 * len(line.name)
        return parts


def _runs(x: Array, y: Array) -> list[tuple[list[float], list[float]]]:
    """The stretches of a line between its gaps."""
    good = np.isfinite(x) & np.isfinite(y)
    rows = np.split(np.arange(len(x)), np.flatnonzero(np.diff(good.astype(int))) + 1)
    return [(x[r].tolist(), y[r].tolist()) for r in rows if len(r) and good[r[0]]]


def _text(u: float, v: float, text: str, anchor: str) -> str:
    return f'<text x="{u:.1f}" y="{v:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(axes: Axes, parts: Sequence[str]) -> str:
    style = "text{font:11px sans-serif;fill:#444}.g{stroke:#e3e3e3;fill:none}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {axes.width} {axes.height}" width="{axes.width}" height="{axes.height}">'
    title = f'<text x="{LEFT}" y="14" style="font-weight:bold;font-size:12px">{escape(axes.title)}</text>'
    return f'{head}<style>{style}</style><rect width="100%" height="100%" fill="white"/>{title}{"".join(parts)}</svg>\n'
