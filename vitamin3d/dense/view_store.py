# SPDX-License-Identifier: Apache-2.0
"""Fused depth views, kept in a file without a name so that they can be taken out of the volume again and fused anew."""

import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import IO

import cv2
import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.types import Array, DepthView

CODES = 65534
"""Steps between the least and the greatest value of a view."""


@dataclass(frozen=True)
class Steps:
    """How 16 bits count the positive numbers of a view, whose bits, read as integers, go about as their logarithms."""

    lowest: int
    """The bits of the least number, code 1; the greatest has at most CODES."""
    shift: int
    """A step is 2 ** shift of them."""


@dataclass(frozen=True)
class Packed:
    """A view in 5 bytes a pixel (grey) or 7: depth and weight in steps of their size, 0 where there is none."""

    timestamp_ns: int
    T_cam_world: Array
    """(4, 4)."""
    shape: tuple[int, int]
    depth_steps: Steps
    weight_steps: Steps
    middle_depth: float
    """Geometric mean of the least and the greatest depth."""
    num_channels: int
    """1 where the picture is grey."""
    data: bytes

    def view(self) -> DepthView:
        """The view, without normals; the same each time, bit by bit."""
        size = self.shape[0] * self.shape[1]
        codes = np.frombuffer(self.data, np.uint16, 2 * size).reshape(2, *self.shape)
        color = np.frombuffer(self.data, np.uint8, self.num_channels * size, 4 * size).reshape(*self.shape, self.num_channels)
        depth, weights = (_decoded(c, steps) for c, steps in zip(codes, (self.depth_steps, self.weight_steps), strict=True))
        rgb = np.array(color) if self.num_channels == 3 else np.asarray(cv2.cvtColor(color, cv2.COLOR_GRAY2RGB))
        return DepthView(self.timestamp_ns, self.T_cam_world, depth, np.zeros((0, 0, 3), np.float32), rgb, weights)


def packed(view: DepthView, max_depth: float = np.inf) -> Packed:
    """The view in few bytes, depth and weights to a part in some thousand, without what lies at `max_depth` or beyond."""
    depth, weights = np.ascontiguousarray(view.depth, np.float32), np.ascontiguousarray(view.weights, np.float32)
    limit = np.float32(max_depth)
    depth_codes, depth_steps, middle = _encoded(depth, depth, limit)
    weight_codes, weight_steps, _ = _encoded(weights, depth, limit)
    color = np.ascontiguousarray(view.color)
    channels = 1 if is_grey(color) else 3
    data = depth_codes.tobytes() + weight_codes.tobytes() + np.ascontiguousarray(color[..., :channels]).tobytes()
    height, width = depth.shape
    return Packed(view.timestamp_ns, view.T_cam_world, (height, width), depth_steps, weight_steps, middle, channels, data)


@kernel
def is_grey(color):  # type: ignore[no-untyped-def]
    """Whether the three channels of a picture (H, W, 3) are the same."""
    for v in range(color.shape[0]):
        for u in range(color.shape[1]):
            if color[v, u, 0] != color[v, u, 1] or color[v, u, 1] != color[v, u, 2]:
                return False
    return True


@kernel
def _span(values, bits, depth, limit):  # type: ignore[no-untyped-def]
    """The least and the greatest bits of the positive values whose depth is positive and below the limit; 0, 0: there are none."""
    lowest, highest = np.int32(0x7FFFFFFF), np.int32(0)
    for n in range(values.shape[0]):
        if values[n] > 0.0 and 0.0 < depth[n] < limit:
            lowest, highest = min(lowest, bits[n]), max(highest, bits[n])
    return (lowest, highest) if highest > 0 else (highest, highest)


@kernel
def _encode(values, bits, depth, limit, lowest, shift, codes):  # type: ignore[no-untyped-def]
    half = (1 << shift) >> 1
    for n in range(values.shape[0]):
        is_there = values[n] > 0.0 and 0.0 < depth[n] < limit
        codes[n] = min(((np.int64(bits[n]) - lowest + half) >> shift) + 1, CODES) if is_there else 0


@kernel
def _decode(codes, lowest, shift, bits):  # type: ignore[no-untyped-def]
    for n in range(codes.shape[0]):
        bits[n] = lowest + ((np.int64(codes[n]) - 1) << shift) if codes[n] > 0 else 0


def _encoded(values: Array, depth: Array, limit: Array) -> tuple[Array, Steps, float]:
    """(H, W) uint16, 0 = none, what they mean, and the geometric mean of the least and the greatest value."""
    flat, where, bits, codes = values.ravel(), depth.ravel(), values.view(np.int32).ravel(), np.empty(values.shape, np.uint16)
    lowest, highest = _span(flat, bits, where, limit)
    shift = max(0, int(highest - lowest) // (CODES - 1)).bit_length()
    _encode(flat, bits, where, limit, lowest, shift, codes.ravel())
    least, greatest = np.array([lowest, highest], np.int32).view(np.float32).astype(np.float64)
    return codes, Steps(int(lowest), shift), float(np.sqrt(least * greatest))


def _decoded(codes: Array, steps: Steps) -> Array:
    """(H, W) float32."""
    values = np.empty(codes.shape, np.float32)
    _decode(codes.ravel(), steps.lowest, steps.shift, values.view(np.int32).ravel())
    return values


@dataclass(frozen=True)
class _Row:
    start: int
    end: int
    packed: Packed
    """Without data."""


class ViewStore:
    """The latest views that fit into `max_bytes` of a temporary file, which goes with the process however that ends."""

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.num_forgotten = 0
        self.failure = ""
        """Why nothing is kept any more: the disk is full, for instance."""
        self._rows: deque[_Row] = deque()
        self._file: IO[bytes] | None = None
        self._end, self.num_bytes = 0, 0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, view: Packed) -> None:
        """Keeps a view; the oldest ones are forgotten where there is no room."""
        size = len(view.data)
        if self.failure or size > self.max_bytes:
            self.num_forgotten += 1
            return
        start = self._end
        if start + size > self.max_bytes:
            start = 0
            self._forget_while(lambda row: row.start >= self._end)
        self._forget_while(lambda row: row.start < start + size and start < row.end)
        try:
            self._write(start, view.data)
        except OSError as error:
            self.failure = f"fused views could not be kept in {tempfile.gettempdir()}: {error}"
            self.num_forgotten += 1
            return
        self._rows.append(_Row(start, start + size, replace(view, data=b"")))
        self._end, self.num_bytes = start + size, max(self.num_bytes, start + size)

    def _forget_while(self, is_in_the_way: Callable[[_Row], bool]) -> None:
        while self._rows and is_in_the_way(self._rows[0]):
            self._rows.popleft()
            self.num_forgotten += 1

    def _write(self, start: int, data: bytes) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        self._file.seek(start)
        written = self._file.write(data)
        if written != len(data):
            raise OSError("no room")

    def headers(self) -> list[Packed]:
        """All views, the oldest first, without their data."""
        return [row.packed for row in self._rows]

    def views(self, chosen: set[int]) -> Iterator[DepthView]:
        """The views with these time stamps (ns), the oldest first."""
        for row in self._rows:
            if row.packed.timestamp_ns in chosen and self._file is not None:
                self._file.seek(row.start)
                yield replace(row.packed, data=self._file.read(row.end - row.start)).view()

    def close(self) -> None:
        """Gives the disk back."""
        if self._file is not None:
            self._file.close()
        self._file = None
        self._rows.clear()
