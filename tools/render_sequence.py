# SPDX-License-Identifier: Apache-2.0
"""Renders the demo sequence: a room with a table, procedural textures, a hand-held sweep, exact poses and depth.

    python tools/render_sequence.py --out data/demo

Nothing is stored but pictures: the textures are functions of the place where a ray ends, filtered to the size of a pixel
there. Light (two lamps and the sky, both with soft shadows) is baked into the vertices of a fine mesh. World: z up, metres.
The same arguments give the same files, bit for bit, on the same machine.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.geometry.se3 import exp_so3, quaternion_xyzw
from vitamin3d.types import Array

START_NS, STEP_NS, FULL_FRAMES = 1_700_000_000_000_000_000, 50_000_000, 150
DEPTH_EVERY = 10
EUROC_DISTORTION = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
TABLE_HEIGHT = 0.75
LAMPS = (((0.9, -1.3, 3.0), 0.45, (2.6, 2.35, 2.0)), ((-2.3, -1.6, 2.3), 0.6, (0.9, 1.05, 1.3)))
"""Centre, radius and power (RGB) of the round lamps."""
SKY = np.array([0.42, 0.44, 0.48])


# Noise


@inlined
def _corner(i, j, k):  # type: ignore[no-untyped-def]
    """A number in [0, 1) for a lattice point."""
    x = np.uint32(i * 374761393 + j * 668265263 + k * 974711) & np.uint32(0xFFFFFFFF)
    x = np.uint32((x ^ (x >> np.uint32(15))) * np.uint32(2246822519))
    x = np.uint32((x ^ (x >> np.uint32(13))) * np.uint32(3266489917))
    return np.float64(np.uint32(x ^ (x >> np.uint32(16)))) / 4294967296.0


@inlined
def _value_noise(x, y, z):  # type: ignore[no-untyped-def]
    """Smooth noise in [-1, 1], of wavelength about 2."""
    i, j, k = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
    fx, fy, fz = x - i, y - j, z - k
    wx, wy, wz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (wx if a else 1 - wx) * (wy if b else 1 - wy) * (wz if c else 1 - wz)
                total += weight * _corner(i + a, j + b, k + c)
    return 2.0 * total - 1.0


@kernel
def _fbm(points, pixel, wavelength, octaves, gain, out):  # type: ignore[no-untyped-def]
    """Octaves of noise; those finer than the pixel are left out."""
    for n in range(points.shape[0]):
        length, amplitude, total = wavelength, 1.0, 0.0
        for octave in range(octaves):
            visible = min(1.0, max(0.0, length / pixel[n] - 2.0))
            if visible > 0.0:
                f = 2.0 / length
                shift = 37.7 * octave
                total += visible * amplitude * _value_noise(points[n, 0] * f + shift, points[n, 1] * f, points[n, 2] * f - shift)
            length *= 0.5
            amplitude *= gain
        out[n] = total


@kernel
def _cells(points, out):  # type: ignore[no-untyped-def]
    """Distances to the nearest and second nearest random point of a unit lattice, and the nearest one's number."""
    for n in range(points.shape[0]):
        base = np.floor(points[n])
        first, second, name = 9.0, 9.0, 0.0
        for step in range(27):
            i, j, k = base[0] + step // 9 - 1, base[1] + step // 3 % 3 - 1, base[2] + step % 3 - 1
            a, b, c = np.int64(i), np.int64(j), np.int64(k)
            x, y, z = i + _corner(a, b, c), j + _corner(a + 71, b, c), k + _corner(a, b + 53, c)
            d = np.sqrt((x - points[n, 0]) ** 2 + (y - points[n, 1]) ** 2 + (z - points[n, 2]) ** 2)
            if d < first:
                first, second, name = d, first, _corner(a, b, c + 97)
            elif d < second:
                second = d
        out[n, 0], out[n, 1], out[n, 2] = first, second, name


@kernel
def _numbers(keys, out):  # type: ignore[no-untyped-def]
    for n in range(keys.shape[0]):
        out[n] = _corner(np.int64(keys[n, 0]), np.int64(keys[n, 1]), np.int64(keys[n, 2]))


# Materials: functions of the spots where rays end


@dataclass(frozen=True)
class Spots:
    """Where rays end on objects of one material; N rays."""

    local: Array
    """(N, 3) metres, in the object's frame, shifted by a number of the object."""
    uv: Array
    """(N, 2) metres along the surface."""
    tint: Array
    """(N, 3) linear RGB."""
    pixel: Array
    """(N,) metres that a ray stands for."""

    def fbm(self, wavelength: float, octaves: int = 5, gain: float = 0.75, stretch: tuple[float, float, float] = (1, 1, 1)) -> Array:
        out = np.empty(len(self.pixel))
        _fbm(self.local * stretch, self.pixel * max(stretch), wavelength, octaves, gain, out)
        return out

    def cells(self, size: float) -> Array:
        """(N, 3) nearest and second nearest distance in units of `size`, number of the cell."""
        out = np.empty((len(self.pixel), 3))
        _cells(self.local / size, out)
        return out


def numbers(*keys: Array | float) -> Array:
    """(N,) in [0, 1) for integer keys."""
    filled = [*keys, *[0.0] * (3 - len(keys))]
    table = np.stack(np.broadcast_arrays(*filled), -1).astype(float).reshape(-1, 3)
    out = np.empty(len(table))
    _numbers(np.floor(table), out)
    return out


def line_mask(distance: Array, width: float, pixel: Array) -> Array:
    """1 within `width` of a line, 0 outside, with an edge as soft as a pixel; faint where thinner than that."""
    soft = 1.2 * pixel
    return np.asarray(np.clip((width - distance) / soft + 0.5, 0, 1) * np.minimum(1.0, 2.0 * width / soft))


def edge_distance(u: Array, v: Array, width: float, height: float) -> Array:
    """Metres to the border of the cell (u, v in cells)."""
    fu, fv = u - np.floor(u), v - np.floor(v)
    return np.asarray(np.minimum(np.minimum(fu, 1 - fu) * width, np.minimum(fv, 1 - fv) * height))


def shaded(tint: Array, factor: Array) -> Array:
    """Tint (N, 3) times factor (N,), which levels out towards 0.25 instead of going black."""
    soft = np.where(factor < 0.55, 0.25 + 0.3 * np.exp((np.minimum(factor, 0.55) - 0.55) / 0.3), factor)
    return np.asarray(tint * np.minimum(soft, 2.0)[:, None])


def mixed(a: Array, b: Array, weight: Array) -> Array:
    return np.asarray(a + (b - a) * weight[:, None])


def brick(s: Spots) -> Array:
    v = s.uv[:, 1] / 0.085 + 0.03 * s.fbm(0.4, 2)
    u = s.uv[:, 0] / 0.26 + 0.5 * (np.floor(v) % 2) + 0.015 * s.fbm(0.3, 2)
    each, hue = numbers(u, v, 1.0), numbers(u, v, 2.0)
    body = shaded(s.tint * (1 + np.outer(hue - 0.5, [0.0, 0.35, 0.5])), 0.55 + 0.75 * each + 0.5 * s.fbm(0.16))
    mortar = shaded(np.full((1, 3), 0.5) * [1.0, 0.95, 0.85], 0.85 + 0.4 * s.fbm(0.1, 4))
    return mixed(body, mortar, line_mask(edge_distance(u, v, 0.26, 0.085), 0.007, s.pixel))


def planks(s: Spots) -> Array:
    v = s.uv[:, 1] / 0.16
    u = s.uv[:, 0] / 1.1 + numbers(v, 0.0, 5.0)
    each = numbers(u, v, 3.0)
    grain = s.fbm(0.34, 5, 0.8, (1.0, 4.0, 4.0)) + 0.5 * np.sin(40 * s.uv[:, 1] + 5 * s.fbm(0.5, 3) + 20 * each)
    body = shaded(s.tint, 0.65 + 0.6 * each + 0.26 * grain + 0.25 * s.fbm(0.13, 4))
    return mixed(body, 0.12 * s.tint, line_mask(edge_distance(u, v, 1.1, 0.16), 0.004, s.pixel))


def wood(s: Spots) -> Array:
    rings = np.sin(60 * s.local[:, 1] + 6 * s.fbm(0.4, 3))
    return shaded(s.tint, 0.95 + 0.16 * rings + 0.3 * s.fbm(0.3, 6, 0.8, (1.0, 4.0, 4.0)) + 0.25 * s.fbm(0.12, 4))


def plaster(s: Spots) -> Array:
    cracks = s.cells(0.42)
    crack = line_mask((cracks[:, 1] - cracks[:, 0]) * 0.42 + 0.01 * s.fbm(0.08, 3), 0.004, s.pixel)
    body = shaded(s.tint, 0.9 + 0.25 * s.fbm(0.9, 3) + 0.3 * s.fbm(0.2, 4, 0.8))
    return mixed(body, 0.35 * s.tint, 0.7 * crack)


def tiles(s: Spots) -> Array:
    u, v = s.uv[:, 0] / 0.2, s.uv[:, 1] / 0.2
    each, dark = numbers(u, v, 4.0), numbers(u, v, 9.0) > 0.72
    vein = np.abs(s.fbm(0.22, 5))
    body = shaded(np.where(dark[:, None], s.tint[:, ::-1] * 0.55, s.tint), 0.5 + 0.3 * each + 0.55 * vein + 0.25 * s.fbm(0.1, 3))
    return mixed(body, np.full((1, 3), 0.62), line_mask(edge_distance(u, v, 0.2, 0.2), 0.004, s.pixel))


def rug(s: Spots) -> Array:
    u, v = s.uv.T
    diamonds = np.floor(u / 0.17 + v / 0.17) + 31 * np.floor(u / 0.17 - v / 0.17)
    hue = numbers(diamonds, 3.0)
    colors = np.array([[0.42, 0.05, 0.05], [0.06, 0.1, 0.3], [0.62, 0.5, 0.3], [0.5, 0.2, 0.06]])[(hue * 4).astype(int)]
    return shaded(colors, 0.85 + 0.5 * s.fbm(0.14, 5, 0.85))


PALETTE = np.array([[0.75, 0.6, 0.34], [0.07, 0.14, 0.26], [0.5, 0.15, 0.08], [0.14, 0.3, 0.27], [0.8, 0.76, 0.66], [0.72, 0.36, 0.1]])
"""Linear RGB of the paintings."""


def painting(s: Spots) -> Array:
    warped = replace(s, local=s.local + 0.05 * np.stack([s.fbm(0.3, 3), s.fbm(0.27, 3), s.fbm(0.33, 3)], 1))
    cells = warped.cells(0.11)
    colors = PALETTE[(numbers(cells[:, 2] * 1e6, 2.0) * len(PALETTE)).astype(int)] * (0.7 + 0.6 * numbers(cells[:, 2] * 1e6, 3.0))[:, None]
    body = shaded(colors, 0.9 + 0.35 * s.fbm(0.07, 3) - 0.4 * cells[:, 0])
    return mixed(body, np.full((1, 3), 0.02), line_mask((cells[:, 1] - cells[:, 0]) * 0.11, 0.005, s.pixel))


def paper(s: Spots) -> Array:
    """Covers and boxes: bands and blocks of print on the tint."""
    u, v = s.uv[:, 0] / 0.05, s.uv[:, 1] / 0.024
    print_ = (numbers(u, v, 6.0) > 0.6) & (numbers(s.uv[:, 1] / 0.12, 7.0) > 0.4)
    inked = np.where(print_[:, None], np.where(s.tint.mean(1, keepdims=True) > 0.25, 0.03, 0.75), s.tint)
    return shaded(inked, 0.85 + 0.4 * s.fbm(0.12, 5, 0.8))


def ceramic(s: Spots) -> Array:
    glaze = s.fbm(0.16, 5, 0.7)
    dark = s.tint[:, ::-1] * 0.35
    return shaded(mixed(s.tint, dark, np.clip(0.5 + 4 * (glaze + 0.5 * np.sin(70 * s.uv[:, 1])), 0, 1)), 0.9 + 0.35 * s.fbm(0.07, 3))


def terrazzo(s: Spots) -> Array:
    cells = s.cells(0.045)
    chips = 0.15 + 0.7 * np.stack([numbers(cells[:, 2] * 1e6, 10.0 + k) for k in range(3)], 1) * s.tint / s.tint.max(axis=1, keepdims=True)
    return shaded(mixed(s.tint, chips, np.clip(6 * (0.55 - cells[:, 0]), 0, 1)), 0.9 + 0.3 * s.fbm(0.15, 4))


MATERIALS: tuple[Callable[[Spots], Array], ...] = (brick, planks, wood, plaster, tiles, rug, painting, paper, ceramic, terrazzo)


# The scene


@dataclass(frozen=True)
class Look:
    """Material and colour (sRGB 0–255) of an object."""

    material: Callable[[Spots], Array]
    color: tuple[int, int, int]
    seed: int = 0


@dataclass(frozen=True)
class Patch:
    """A grid of vertices with one look; V vertices."""

    vertices: Array
    """(V, 3) world."""
    normals: Array
    """(V, 3)."""
    local: Array
    """(V, 3) in the object's frame."""
    uv: Array
    """(V, 2) metres."""
    triangles: Array
    """(F, 3)."""
    look: Look


def grid_patch(points: Array, normals: Array, uv: Array, look: Look, position: Array, yaw: float) -> Patch:
    """Patch of a grid (U, V, 3) in the object's frame, turned about z by `yaw` radians and moved."""
    R = exp_so3(np.array([0.0, 0.0, yaw]))
    local = points.reshape(-1, 3)
    index = np.arange(len(local)).reshape(points.shape[:2])
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Patch(local @ R.T + position, normals.reshape(-1, 3) @ R.T, local, uv.reshape(-1, 2), triangles, look)


def quad(origin: Array, along_u: Array, along_v: Array, look: Look, spacing: float, position: Array, yaw: float) -> Patch:
    """A rectangle whose normal is `along_u` × `along_v`, in cells of about `spacing`."""
    sizes = float(np.linalg.norm(along_u)), float(np.linalg.norm(along_v))
    u, v = (np.linspace(0, 1, max(2, int(np.ceil(size / spacing)) + 1)) for size in sizes)
    points = origin + u[:, None, None] * along_u + v[None, :, None] * along_v
    uv = np.stack(np.broadcast_arrays(u[:, None] * sizes[0], v[None] * sizes[1]), -1)
    normal = np.cross(along_u, along_v) / (sizes[0] * sizes[1])
    return grid_patch(points, np.broadcast_to(normal, points.shape), uv, look, position, yaw)


def box(bottom: tuple[float, float, float], size: tuple[float, float, float], look: Look, spacing: float, yaw: float = 0.0) -> list[Patch]:
    """A box that stands on the centre `bottom` of its lower face."""
    half = np.array([size[0] / 2, size[1] / 2, 0.0])
    X, Y, Z = np.diag(size)
    low, high = -half, half + Z
    sides = ((low, X, Z), (low + X, Y, Z), (high - Z, -X, Z), (low + Y, -Y, Z), (low + Z, X, Y), (low + Y, X, -Y))
    return [quad(origin, u, v, look, spacing, np.array(bottom), yaw) for origin, u, v in sides]


def lathe(position: tuple[float, float, float], profile: Array, look: Look, segments: int = 64) -> list[Patch]:
    """The surface of a profile (M, 2) of radius and height, turned about z."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    angle[-1] = 0.0
    r, z = profile[:, 0], profile[:, 1]
    points = np.stack(np.broadcast_arrays(np.cos(angle)[:, None] * r, np.sin(angle)[:, None] * r, z), -1)
    dr, dz = np.gradient(r), np.gradient(z)
    length = np.maximum(np.hypot(dr, dz), 1e-12)
    normals = np.stack(np.broadcast_arrays(np.cos(angle)[:, None] * dz, np.sin(angle)[:, None] * dz, -dr), -1) / length[:, None]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(r), np.diff(z)))])
    uv = np.stack(np.broadcast_arrays(np.linspace(0, 2 * np.pi, segments + 1)[:, None] * r.max(), arc), -1)
    return [grid_patch(points, normals, uv, look, np.array(position), 0.0)]


def disc_profile(radius: float, height: float) -> Array:
    """Profile of a closed cylinder, with slightly rounded rims."""
    e = 0.004
    return np.array([[0, 0], [radius - e, 0], [radius, e], [radius, height / 2], [radius, height - e], [radius - e, height], [0, height]])


def ring_profile(radius: float, tube: float) -> Array:
    """Profile of a torus that lies on the floor."""
    a = np.linspace(-np.pi, np.pi, 33)
    return np.stack([radius + tube * np.cos(a), tube + tube * np.sin(a)], 1)


def ball_profile(radius: float) -> Array:
    a = np.linspace(-np.pi / 2, np.pi / 2, 41)
    return np.stack([radius * np.cos(a), radius + radius * np.sin(a)], 1)


VASE = ((0, 0.06, 0.1, 0.115, 0.09, 0.045, 0.04, 0.065, 0.055, 0), (0, 0, 0.06, 0.14, 0.23, 0.31, 0.35, 0.4, 0.4, 0.3))
POT = ((0, 0.08, 0.125, 0.135, 0.11, 0.06, 0.062, 0.03, 0.022, 0), (0, 0, 0.05, 0.1, 0.15, 0.17, 0.18, 0.2, 0.225, 0.235))
BOWL = ((0, 0.06, 0.12, 0.155, 0.15, 0.11, 0), (0, 0, 0.04, 0.09, 0.09, 0.045, 0.02))
"""Radii and heights of things turned on a lathe, metres."""


def curve_profile(shape: tuple[tuple[float, ...], tuple[float, ...]]) -> Array:
    """A smooth profile (M, 2) through points of radius and height."""
    from scipy.interpolate import PchipInterpolator

    table = np.array(shape).T
    s = np.linspace(0, 1, len(table))
    return np.asarray(PchipInterpolator(s, table)(np.linspace(0, 1, 8 * len(table))))


def room(h: float) -> list[Patch]:
    """Floor, ceiling and four walls, seen from inside."""
    x, y0, y1, z = 2.6, -3.0, 1.75, 3.2
    zero, X, Y, Z = np.zeros(3), np.array([2 * x, 0, 0]), np.array([0, y1 - y0, 0]), np.array([0, 0, z])
    corner = np.array([-x, y0, 0.0])
    sides = (
        (corner, X, Y, Look(planks, (168, 118, 74), 1)),
        (corner + Y, X, Z, Look(brick, (166, 100, 80), 2)),
        (corner, Y, Z, Look(plaster, (190, 196, 178), 3)),
        (corner + X + Y, -Y, Z, Look(plaster, (206, 186, 150), 4)),
        (corner + X, -X, Z, Look(plaster, (200, 200, 200), 5)),
        (corner + Y + Z, X, -Y, Look(planks, (214, 204, 186), 6)),
    )
    return [quad(origin, u, v, look, h, zero, 0.0) for origin, u, v, look in sides]


def wall_things(h: float) -> list[Patch]:
    """Tiled wainscots, pictures and their frames."""
    frame = Look(wood, (70, 44, 26), 11)
    return [
        *box((-2.58, -0.6, 0.0), (0.04, 4.6, 1.0), Look(tiles, (150, 178, 190), 12), h),
        *box((2.58, -0.6, 0.0), (0.04, 4.6, 0.8), Look(tiles, (196, 170, 130), 13), h),
        *box((0.25, 1.72, 1.2), (1.3, 0.05, 0.95), frame, h),
        *box((0.25, 1.69, 1.26), (1.18, 0.02, 0.83), Look(painting, (200, 200, 200), 14), h),
        *box((2.57, 0.55, 1.15), (0.05, 1.1, 0.85), frame, h),
        *box((2.54, 0.55, 1.21), (0.02, 0.98, 0.73), Look(painting, (200, 200, 200), 27), h),
        *box((-2.57, 0.2, 1.3), (0.04, 0.9, 1.1), Look(paper, (222, 208, 170), 16), h),
        *box((1.75, 1.71, 1.3), (0.6, 0.03, 0.85), Look(rug, (200, 200, 200), 17), h),
    ]


def shelf(h: float, random: np.random.Generator) -> list[Patch]:
    """A bookshelf in the corner, full of books."""
    oak = Look(wood, (150, 104, 62), 21)
    patches = [p for x in (-2.28, -0.92) for p in box((x, 1.57, 0.0), (0.04, 0.32, 2.05), oak, h)]
    patches += [p for z in (0.05, 0.45, 0.85, 1.25, 1.65, 2.01) for p in box((-1.6, 1.57, z), (1.32, 0.32, 0.035), oak, h)]
    for row, z in enumerate((0.085, 0.485, 0.885, 1.285, 1.685)):
        x = -2.24
        while x < -1.02:
            width, height, depth = random.uniform(0.03, 0.075), random.uniform(0.2, 0.33), random.uniform(0.18, 0.26)
            grey, spread = random.uniform(60, 190), random.uniform(-55, 55, 3)
            color = (int(grey + spread[0]), int(grey + spread[1]), int(grey + spread[2]))
            look = Look(paper, color, 100 + 50 * row + len(patches))
            patches += box((x + width / 2, 1.45 + depth / 2, z), (width - 0.003, depth, height), look, h, random.uniform(-0.04, 0.04))
            x += width
    return patches


def table(h: float) -> list[Patch]:
    """The table, the rug and the boxes under it."""
    oak = Look(wood, (172, 116, 66), 31)
    legs = [p for x in (-0.72, 0.72) for y in (-0.32, 0.52) for p in box((x, y, 0.0), (0.07, 0.07, 0.71), oak, h)]
    return [
        *legs,
        *box((0.0, 0.1, 0.71), (1.7, 1.05, 0.04), oak, h),
        *box((0.0, 0.0, 0.0), (2.9, 2.0, 0.012), Look(rug, (150, 40, 40), 32), h),
        *box((-0.25, 0.2, 0.012), (0.5, 0.4, 0.36), Look(paper, (186, 142, 92), 33), h, 0.3),
        *box((1.75, 1.1, 0.0), (0.6, 0.5, 0.55), Look(paper, (176, 134, 90), 34), h, 0.35),
        *box((1.72, 1.12, 0.55), (0.4, 0.36, 0.3), Look(paper, (120, 150, 170), 35), h, -0.2),
        *lathe((1.2, -0.1, 0.012), ball_profile(0.19), Look(painting, (200, 90, 60), 36)),
        *lathe((-1.35, 0.6, 0.0), disc_profile(0.2, 0.5), Look(wood, (190, 140, 90), 37)),
    ]


def still_life(h: float) -> list[Patch]:
    """What stands on the table."""
    z = TABLE_HEIGHT
    books = ((0.34, 0.25, 0.05, 0.1), (0.31, 0.22, 0.04, -0.2), (0.27, 0.2, 0.055, 0.25), (0.22, 0.16, 0.035, 0.0))
    covers = ((150, 50, 44), (44, 80, 120), (206, 180, 120), (70, 110, 70))
    patches, level = [], z
    for i, (width, depth, height, yaw) in enumerate(books):
        patches += box((-0.55, 0.3, level), (width, depth, height), Look(paper, covers[i], 41 + i), h, yaw)
        level += height
    return [
        *patches,
        *lathe((-0.55, 0.3, level), ball_profile(0.07), Look(terrazzo, (220, 150, 120), 47)),
        *lathe((-0.1, 0.38, z), ball_profile(0.15), Look(terrazzo, (90, 130, 170), 48)),
        *lathe((0.28, 0.4, z), curve_profile(VASE), Look(ceramic, (90, 140, 190), 49)),
        *lathe((0.42, -0.12, z), curve_profile(POT), Look(ceramic, (226, 190, 120), 50)),
        *lathe((-0.15, -0.08, z), ring_profile(0.11, 0.045), Look(terrazzo, (210, 200, 180), 51)),
        *lathe((0.1, 0.12, z), curve_profile(BOWL), Look(ceramic, (180, 90, 70), 52)),
        *lathe((0.7, 0.1, z), disc_profile(0.065, 0.17), Look(paper, (190, 60, 50), 53), 48),
        *box((0.62, 0.42, z), (0.24, 0.18, 0.28), Look(paper, (196, 152, 98), 54), h, 0.4),
        *box((-0.52, -0.18, z), (0.1, 0.1, 0.1), Look(wood, (220, 170, 90), 55), h, 0.5),
        *box((-0.39, -0.26, z), (0.08, 0.08, 0.08), Look(painting, (90, 140, 80), 56), h, -0.2),
    ]


def scene_patches(spacing: float, seed: int) -> list[Patch]:
    """The whole scene in cells of about `spacing` metres; the surface is the same for every spacing."""
    random = np.random.default_rng(seed)
    return [*room(spacing), *wall_things(spacing), *shelf(spacing, random), *table(spacing), *still_life(spacing)]


# Ray casting


class Scene:
    """The scene, ready to be looked at."""

    def __init__(self, patches: list[Patch], light_samples: int, seed: int) -> None:
        self._looks = [patch.look for patch in patches]
        counts = [len(patch.vertices) for patch in patches]
        starts = np.cumsum([0, *counts[:-1]])
        self.vertices = np.concatenate([p.vertices for p in patches])
        self.triangles = np.concatenate([p.triangles + s for p, s in zip(patches, starts, strict=True)])
        self._normals = np.concatenate([p.normals for p in patches])
        self._local = np.concatenate([p.local for p in patches])
        self._uv = np.concatenate([p.uv for p in patches])
        self._patch = np.repeat(np.arange(len(patches)), [len(p.triangles) for p in patches])
        self._caster = ray_caster(self.vertices, self.triangles)
        self._light = self._baked(light_samples, seed)

    def depth(self, origin: Array, rays: Array) -> Array:
        """(N,) how often each ray (N, 3) fits between `origin` and the surface; inf where it meets none."""
        return np.asarray(self._cast(origin, rays)["t_hit"].numpy())

    def colors(self, origin: Array, rays: Array, angle: float) -> Array:
        """(N, 3) linear RGB of rays (N, 3), each of which stands for a cone of `angle` radians."""
        hit = self._cast(origin, rays)
        t, faces = hit["t_hit"].numpy().astype(float), hit["primitive_ids"].numpy().astype(np.int64)
        seen = np.flatnonzero(np.isfinite(t))
        bary = hit["primitive_uvs"].numpy().astype(float)[seen]
        weights = np.column_stack([1 - bary.sum(1), bary])
        corners, patch = self.triangles[faces[seen]], self._patch[faces[seen]]
        local, uv, light = (np.einsum("nk,nkc->nc", weights, table[corners]) for table in (self._local, self._uv, self._light))
        out = np.zeros((len(rays), 3))
        out[seen] = self._albedo(local, uv, patch, t[seen] * angle) * light
        return out

    def _albedo(self, local: Array, uv: Array, patch: Array, pixel: Array) -> Array:
        out = np.zeros((len(patch), 3))
        tints = (np.array([look.color for look in self._looks]) / 255.0) ** 2.2
        seeds = np.array([look.seed for look in self._looks], float)
        kinds = np.array([MATERIALS.index(look.material) for look in self._looks])
        for kind in np.unique(kinds[patch]):
            which = np.flatnonzero(kinds[patch] == kind)
            shift = seeds[patch[which], None] * [3.7, 5.3, 7.1]
            out[which] = MATERIALS[kind](Spots(local[which] + shift, uv[which], tints[patch[which]], pixel[which]))
        return out

    def _baked(self, samples: int, seed: int) -> Array:
        """(V, 3) light that reaches the vertices: lamps and sky, as far as nothing is in the way."""
        random = np.random.default_rng(seed)
        light = np.zeros_like(self.vertices)
        start = self.vertices + 2e-3 * self._normals
        for center, radius, power in LAMPS:
            for offset in radius * disc_points(samples, random):
                towards = np.append(offset, 0.0) + center - start
                distance = np.linalg.norm(towards, axis=1)
                cosine = np.clip((towards * self._normals).sum(1) / distance, 0, 1)
                light += np.outer(cosine * self._free(start, towards, 1.0) * (4.0 / (1.0 + distance**2)) / samples, power)
        for direction in sphere_points(2 * samples, random):
            flipped = np.where((self._normals @ direction)[:, None] < 0, -direction, direction)
            cosine = np.abs(self._normals @ direction)
            light += np.outer(cosine * self._free(start, flipped, 0.9) / samples, SKY)
        return light

    def _free(self, start: Array, towards: Array, reach: float) -> Array:
        rays = np.concatenate([start, towards], 1).astype(np.float32)
        hidden = self._caster.test_occlusions(as_tensor(rays), tnear=1e-3, tfar=reach).numpy()
        return np.asarray(np.logical_not(hidden))

    def _cast(self, origin: Array, rays: Array) -> Any:
        table = np.concatenate([np.broadcast_to(origin, rays.shape), rays], 1).astype(np.float32)
        return self._caster.cast_rays(as_tensor(table))


def ray_caster(vertices: Array, triangles: Array) -> Any:
    import open3d as o3d

    caster = o3d.t.geometry.RaycastingScene(nthreads=1)
    caster.add_triangles(as_tensor(vertices.astype(np.float32)), as_tensor(triangles.astype(np.uint32)))
    return caster


def as_tensor(array: Array) -> Any:
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


def disc_points(count: int, random: np.random.Generator) -> Array:
    """(count, 2) points that fill the unit disc evenly."""
    n = np.arange(count) + 0.5
    angle = np.pi * (1 + 5**0.5) * n + random.uniform(0, 2 * np.pi)
    return np.asarray(np.sqrt(n / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1))


def sphere_points(count: int, random: np.random.Generator) -> Array:
    """(count, 3) directions that fill the half of the unit sphere with z > 0 evenly."""
    n = np.arange(count) + 0.5
    z, angle = n / count, np.pi * (1 + 5**0.5) * n + random.uniform(0, 2 * np.pi)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)


# The camera


def demo_camera(width: int, height: int) -> PinholeCamera:
    """EuRoC's lens on a picture of this size."""
    return PinholeCamera(0.61 * width, 0.608 * width, 0.4883 * width, 0.5174 * height, width, height, EUROC_DISTORTION)


def pose_at(seconds: float) -> Array:
    """T_world_cam (4, 4): a sweep around the table at about 0.5 m/s, with the sway of a hand; 0 to 7.5 s."""
    t = seconds
    angle = np.deg2rad(-43.0 + 86.0 * t / 7.5)
    radius = 2.3 + 0.15 * np.sin(0.9 * t + 0.5)
    sway = 0.012 * np.array([np.sin(5.1 * t), np.sin(4.3 * t + 1.0), np.sin(6.0 * t + 2.0)])
    orbit = np.array([radius * np.sin(angle), 0.15 - radius * np.cos(angle), 1.45 + 0.16 * np.sin(0.8 * t)])
    eye = orbit + sway
    target = np.array([0.12 * np.sin(1.1 * t), 0.35, 0.88 + 0.05 * np.sin(1.3 * t + 0.4)])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.03 * np.sin(1.7 * t), 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = eye
    return T


def rays_of(camera: PinholeCamera, samples: int) -> Array:
    """(H · W · samples², 3) rays with z = 1; the samples of a pixel are neighbours in the last axis of the grid."""
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    v, u, dv, du = np.meshgrid(np.arange(camera.height), np.arange(camera.width), steps, steps, indexing="ij")
    return camera.rays_from_ideal(camera.undistort(np.stack([(u + du).ravel(), (v + dv).ravel()], 1)))


def picture(scene: Scene, camera: PinholeCamera, T_world_cam: Array, rays: Array, samples: int) -> Array:
    """(H, W, 3) sRGB in 0–255, float."""
    linear = scene.colors(T_world_cam[:3, 3], rays @ T_world_cam[:3, :3].T, 1.0 / (camera.fx * samples))
    mean = linear.reshape(camera.height, camera.width, samples * samples, 3).mean(axis=2)
    return np.asarray(255.0 * (mean / (1.0 + 0.18 * mean)) ** (1 / 2.2))


def depth_map(scene: Scene, camera: PinholeCamera, T_world_cam: Array) -> Array:
    """(H, W) uint16 millimetres along z at the pixels' centres, 0 = none."""
    depth = scene.depth(T_world_cam[:3, 3], rays_of(camera, 1) @ T_world_cam[:3, :3].T)
    millimetres = np.where(np.isfinite(depth) & (depth < 65), np.round(1000 * depth), 0)
    return millimetres.astype(np.uint16).reshape(camera.height, camera.width)


# Files


def write_sensor(path: Path, camera: PinholeCamera) -> None:
    numbers_ = ", ".join(f"{value:.6g}" for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    lens = ", ".join(f"{value:.9g}" for value in camera.distortion)
    path.write_text(
        "%YAML:1.0\nsensor_type: camera\ncomment: rendered by tools/render_sequence.py; body frame = cam0\n"
        "T_BS:\n  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, 0.0,\n         0.0, 1.0, 0.0, 0.0,\n"
        "         0.0, 0.0, 1.0, 0.0,\n         0.0, 0.0, 0.0, 1.0]\n"
        f"rate_hz: 20\nresolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{numbers_}] #fu, fv, cu, cv\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: [{lens}]\n",
        encoding="utf-8",
    )


def write_tables(out: Path, times_ns: list[int], poses: list[Array]) -> None:
    """The lists of pictures and of poses."""
    frames = "".join(f"{t},{t}.jpg\n" for t in times_ns)
    (out / "mav0/cam0/data.csv").write_text(f"#timestamp [ns],filename\n{frames}", encoding="utf-8")
    head = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    states = "".join(f"{t},{_state(T)}\n" for t, T in zip(times_ns, poses, strict=True))
    (out / "mav0/state_groundtruth_estimate0/data.csv").write_text(head + states, encoding="utf-8")


def _state(T_world_cam: Array) -> str:
    x, y, z, w = quaternion_xyzw(T_world_cam[:3, :3])
    return ",".join(f"{value:.9f}" for value in [*T_world_cam[:3, 3], w, x, y, z])


def write_scene(path: Path, patches: list[Patch]) -> None:
    """The surface as a binary PLY."""
    import open3d as o3d

    starts = np.cumsum([0, *[len(p.vertices) for p in patches[:-1]]])
    vertices = np.concatenate([p.vertices for p in patches])
    triangles = np.concatenate([p.triangles + s for p, s in zip(patches, starts, strict=True)])
    mesh = o3d.t.geometry.TriangleMesh(as_tensor(vertices.astype(np.float32)), as_tensor(triangles.astype(np.int32)))
    o3d.t.io.write_triangle_mesh(str(path), mesh)


def frames_of(args: argparse.Namespace) -> Iterator[tuple[int, int, Array]]:
    """Index, time in nanoseconds and pose of each frame."""
    for index in range(args.frames):
        yield index, START_NS + index * STEP_NS, pose_at(index * STEP_NS * 1e-9)


def render(args: argparse.Namespace) -> None:
    """Renders and writes the sequence."""
    out: Path = args.out
    for folder in ("mav0/cam0/data", "mav0/state_groundtruth_estimate0", "depth0"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    # What is written rounds the camera; what is rendered uses the rounded one.
    camera = rounded(demo_camera(*args.size))
    scene = Scene(scene_patches(args.spacing, args.seed), args.light_samples, args.seed)
    rays, random = rays_of(camera, args.samples), np.random.default_rng(args.seed)
    for index, time_ns, T_world_cam in frames_of(args):
        exact = picture(scene, camera, T_world_cam, rays, args.samples)
        noisy = np.clip(np.round(exact + args.noise * random.standard_normal(exact.shape)), 0, 255).astype(np.uint8)
        name = str(out / "mav0/cam0/data" / f"{time_ns}.jpg")
        cv2.imwrite(name, noisy[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, args.quality])
        if index % DEPTH_EVERY == 0:
            cv2.imwrite(str(out / "depth0" / f"{time_ns}.png"), depth_map(scene, camera, T_world_cam))
            print(f"frame {index + 1} of {args.frames}", flush=True)
    write_sensor(out / "mav0/cam0/sensor.yaml", camera)
    write_tables(out, [time for _, time, _ in frames_of(args)], [T for _, _, T in frames_of(args)])
    write_scene(out / "scene.ply", scene_patches(10.0, args.seed))


def rounded(camera: PinholeCamera) -> PinholeCamera:
    """The camera as its file will say it."""
    fx, fy, cx, cy = (float(f"{value:.6g}") for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return PinholeCamera(fx, fy, cx, cy, camera.width, camera.height, camera.distortion)


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Render the demo sequence.")
    parser.add_argument("--out", type=Path, default=Path("data/demo"), help="folder to write (default: data/demo)")
    parser.add_argument("--frames", type=int, default=FULL_FRAMES, help=f"frames at 20 Hz, at most {FULL_FRAMES}")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 320), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise", type=float, default=1.0, help="standard deviation in grey levels")
    parser.add_argument("--quality", type=int, default=88, help="of the JPEG files")
    parser.add_argument("--quick", action="store_true", help="one sample per pixel, coarse light")
    args = parser.parse_args(argv)
    if not 2 <= args.frames <= FULL_FRAMES or min(args.size) < 16:
        parser.error(f"--frames must be 2 to {FULL_FRAMES}, --size at least 16 16")
    args.samples, args.spacing, args.light_samples = (1, 0.2, 4) if args.quick else (2, 0.025, 24)
    return args


def main(argv: list[str] | None = None) -> int:
    render(parsed(argv))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
