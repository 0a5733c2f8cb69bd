# SPDX-License-Identifier: Apache-2.0
"""Fused depth views, kept in a file without a name so that they can be taken out of the volume again and fused anew."""

import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import IO

import numpy as np

from vitamin3d.types import Array, DepthView

CODES = 65534
"""Steps of the logarithm between the least and the greatest value of a view."""


@dataclass(frozen=True)
class Packed:
    """A view in 5 bytes a pixel (grey) or 7: depth and weight as steps of their logarithms, 0 where there is none."""

    timestamp_ns: int
    T_cam_world: Array
    """(4, 4)."""
    shape: tuple[int, int]
    depth_range: tuple[float, float]
    weight_range: tuple[float, float]
    num_channels: int
    """1 where the picture is grey."""
    data: bytes

    @property
    def middle_depth(self) -> float:
        """Of the depths, as the logarithm goes."""
        return float(np.exp(0.5 * sum(self.depth_range)))

    def view(self) -> DepthView:
        """The view, without normals; the same each time, bit by bit."""
        size = self.shape[0] * self.shape[1]
        codes = np.frombuffer(self.data, np.uint16, 2 * size).reshape(2, *self.shape)
        color = np.frombuffer(self.data, np.uint8, self.num_channels * size, 4 * size).reshape(*self.shape, self.num_channels)
        depth, weights = (_decoded(c, r) for c, r in zip(codes, (self.depth_range, self.weight_range), strict=True))
        no_normals = np.zeros((0, 0, 3), np.float32)
        return DepthView(self.timestamp_ns, self.T_cam_world, depth, no_normals, np.repeat(color, 3 // self.num_channels, axis=2), weights)


def packed(view: DepthView) -> Packed:
    """The view in few bytes: depth and weights to a part in some thousand."""
    depth, depth_range = _encoded(view.depth)
    weights, weight_range = _encoded(np.where(view.depth > 0, view.weights, np.float32(0.0)))
    is_grey = (view.color[..., 0] == view.color[..., 1]).all() and (view.color[..., 1] == view.color[..., 2]).all()
    channels = 1 if is_grey else 3
    data = depth.tobytes() + weights.tobytes() + np.ascontiguousarray(view.color[..., :channels]).tobytes()
    height, width = view.depth.shape
    return Packed(view.timestamp_ns, view.T_cam_world, (height, width), depth_range, weight_range, channels, data)


def _encoded(values: Array) -> tuple[Array, tuple[float, float]]:
    """(H, W) uint16 and the logarithms of the least and the greatest positive value."""
    there = values > 0
    if not there.any():
        return np.zeros(values.shape, np.uint16), (0.0, 0.0)
    logarithms = np.log(values, out=np.zeros(values.shape, np.float32), where=there)
    low, high = float(logarithms[there].min()), float(logarithms[there].max())
    steps = np.rint((logarithms - low) * np.float32(CODES / max(high - low, 1e-6)))
    return np.where(there, np.clip(steps, 0, CODES) + 1, 0).astype(np.uint16), (low, high)


def _decoded(codes: Array, limits: tuple[float, float]) -> Array:
    """(H, W) float32."""
    low, high = limits
    values = np.exp(np.arange(CODES + 1, dtype=np.float64) * (max(high - low, 1e-6) / CODES) + low)
    return np.concatenate([[0.0], values]).astype(np.float32)[codes]


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
