# SPDX-License-Identifier: Apache-2.0
"""Clouds and meshes of any system: PLY, PCD, OBJ, and text (`MapPoints.txt`, xyz).

PCD is read by Open3D 0.19. PLY and OBJ are not: it ends the process at a polygon whose corner is not there, gives up a mesh for one
flat or bent polygon, returns what was never written for an OBJ with lines, and prints of PLY whatever its verbosity.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from vitamin3d.errors import InputError
from vitamin3d.types import Array

SUFFIXES = (".ply", ".pcd", ".obj", ".txt", ".xyz", ".csv", ".asc", ".pts")
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
Property: TypeAlias = tuple[str, "np.dtype[Any]", "np.dtype[Any] | None"]
"""Of a PLY: its name, type, and the type of the length where it is a list."""
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
FAR = 30.0
"""A point farther from the middle than this many times the 90th percentile of all is an outlier."""
MOST_OUTLIERS = 0.02
"""Above this share far points are no outliers: the cloud has that shape."""


@dataclass(frozen=True)
class Geometry:
    """Points, and the triangles between them where the file is a mesh."""

    points: Array
    """(N, 3) float64."""
    triangles: Array
    """(F, 3) int64; none: a cloud."""
    colors: Array | None = None
    """(N, 3) uint8 RGB."""
    outliers: int = 0
    """Points of the file that are left out: not finite, or far from everything else."""

    @property
    def is_mesh(self) -> bool:
        return len(self.triangles) > 0


@np.errstate(invalid="ignore", over="ignore")  # of a damaged file any number may come
def read_geometry(path: Path) -> Geometry:
    """A cloud or mesh without its outlying points.

    Raises:
        InputError: the file cannot be read, is of another kind, cut short, or holds no finite point.
    """
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: an empty file, so an empty cloud; give a file with points")
    reader = {".ply": _read_ply, ".pcd": _read_pcd, ".obj": _read_obj}.get(path.suffix.lower(), _read_text)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    try:
        read = reader(path, data)
    except (ValueError, LookupError, OverflowError, RuntimeError, MemoryError):
        raise InputError(f"{path}: damaged or cut short; export it again") from None
    if len(read.points) == 0:
        raise InputError(f"{path}: an empty cloud; give a file with points")
    return without_outliers(read, path)


def without_outliers(geometry: Geometry, path: Path) -> Geometry:
    """The geometry less what is not finite and points far from all others: one point at 2 km hides a room."""
    finite: Array = np.asarray(np.isfinite(geometry.points).all(axis=1))
    if finite.sum() < 3:
        raise InputError(
            f"{path}: {finite.sum()} of its {len(geometry.points)} points are finite numbers, three are needed; export it again"
        )
    if (geometry.points[finite] == geometry.points[finite][0]).all():
        raise InputError(f"{path}: all points are the same; was it exported with a scale of zero?")
    distance = np.linalg.norm(geometry.points - np.median(geometry.points[finite], axis=0), axis=1)
    far = finite & (distance > FAR * max(float(np.percentile(distance[finite], 90)), 1e-12))
    keep: Array = finite & ~far if far.sum() <= MOST_OUTLIERS * finite.sum() else finite
    return geometry if keep.all() else _kept(geometry, keep)


def _kept(geometry: Geometry, keep: Array) -> Geometry:
    number = np.cumsum(keep) - 1
    triangles = number[geometry.triangles[keep[geometry.triangles].all(axis=1)]] if geometry.is_mesh else geometry.triangles
    colors = None if geometry.colors is None else geometry.colors[keep]
    return Geometry(geometry.points[keep], triangles, colors, int((~keep).sum()))


NO_TRIANGLES = np.zeros((0, 3), np.int64)


def _read_ply(path: Path, data: bytes) -> Geometry:
    head, _, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not body:
        raise InputError(f"{path}: not a PLY file; name it by its format, or export it again")
    tables = _ply_tables([line.split() for line in head.decode("ascii", "replace").splitlines()], body.partition(b"\n")[2])
    vertex = tables.get("vertex", {})
    if not {"x", "y", "z"} <= set(vertex):
        raise InputError(f"{path}: no vertices with x, y and z; export it again")
    points = np.stack([vertex[c] for c in "xyz"], axis=1).astype(np.float64)
    faces = next((column for name, column in tables.get("face", {}).items() if name.startswith("vertex_ind")), NO_TRIANGLES)
    return Geometry(points, _checked(faces, len(points)), _colors(vertex))


def _ply_tables(head: list[list[str]], body: bytes) -> dict[str, dict[str, Array]]:
    """Columns by the names of element and property. Text is read as if it were binary: all numbers are float64."""
    form = {words[0]: words[1] for words in head if len(words) > 1}["format"]
    order, is_text = PLY_ORDERS[form], form == "ascii"
    body = np.array(body.split(), "<f8").tobytes() if is_text else body
    elements = list[tuple[str, int, list[Property]]]()
    for words in head:
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            codes = [PLY_TYPES[word] for word in words[-2:0:-1] if word != "list"]
            types = [np.dtype("<f8" if is_text else order + code) for code in codes]
            elements[-1][2].append((words[-1], types[0], types[1] if words[1] == "list" else None))
    tables, start = dict[str, dict[str, Array]](), 0
    for name, count, properties in elements:
        tables[name], start = _ply_rows(body, start, count, properties)
    if start > len(body) or (is_text and start < len(body)):
        raise ValueError("more or fewer numbers than declared")
    return tables


def _ply_rows(body: bytes, start: int, count: int, properties: list[Property]) -> tuple[dict[str, Array], int]:
    """An element's columns and where it ends: at once where all lists are triangles, else row by row, larger polygons as fans."""
    fields, lists = list[Any](), [name for name, _, length in properties if length is not None]
    for name, kind, length in properties:
        fields += [(name, kind)] if length is None else [(f"# {name}", length), (name, kind, (3,))]
    row = np.dtype(fields)
    if not lists or start + row.itemsize * count <= len(body):
        rows = np.frombuffer(body, row, count, start)
        if all((rows[f"# {name}"] == 3).all() for name in lists):
            return {name: rows[name] for name, *_ in properties}, start + row.itemsize * count
    fans = list[list[int]]()
    for _ in range(count):
        for name, kind, length in properties:
            size = 1 if length is None else int(np.frombuffer(body, length, 1, start)[0])
            start += 0 if length is None else length.itemsize
            fans += _fan(np.frombuffer(body, kind, size, start).tolist()) if name.startswith("vertex_ind") else []
            start += kind.itemsize * size
    return {"vertex_indices": np.array(fans, np.int64).reshape(-1, 3)}, start


def _fan(polygon: list[int]) -> list[list[int]]:
    return [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]


def _colors(vertex: dict[str, Array]) -> Array | None:
    for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        if set(names) <= set(vertex):
            values = np.stack([vertex[name] for name in names], axis=1)
            scale = 255.0 if values.dtype.kind == "f" and values.max(initial=0) <= 1.0 else 1.0
            return np.asarray(np.clip(values * scale, 0, 255).astype(np.uint8))
    return None


def _checked(triangles: Array, count: int) -> Array:
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < count):
        raise ValueError("a triangle of a vertex that is not there")
    return triangles.astype(np.int64)


def _read_pcd(path: Path, data: bytes) -> Geometry:
    head, _, body = data.partition(b"\nDATA ")
    count = int(re.findall(rb"^POINTS +(\d+)", head, re.MULTILINE)[0])
    if body.startswith(b"ascii") and len(np.array([row.split() for row in body.splitlines()[1:] if row.strip()], np.float64)) < count:
        raise ValueError("cut short, or no numbers: Open3D does not say so")
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        found = o3d.t.io.read_point_cloud(str(path)).point
    points = found["positions"].numpy() if "positions" in found else np.zeros((0, 3))
    if len(points) != count:
        raise InputError(f"{path}: damaged, cut short, or without x, y and z; export it again")
    return Geometry(points.astype(np.float64), NO_TRIANGLES, found["colors"].numpy() if "colors" in found else None)


def _read_obj(path: Path, data: bytes) -> Geometry:
    points, triangles = [], list[list[int]]()
    for words in (line.split() for line in data.decode("ascii", "replace").splitlines()):
        if words[:1] == ["v"]:
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.split("/")[0]) for word in words[1:]]
            triangles += _fan([c - 1 if c > 0 else len(points) + c for c in corners])
    return Geometry(np.array(points, np.float64).reshape(-1, 3), _checked(np.array(triangles, np.int64).reshape(-1, 3), len(points)))


def _read_text(path: Path, data: bytes) -> Geometry:
    """x, y and z per line, and whatever else; by spaces or commas, with or without a line of names."""
    lines = [line.replace(",", " ").replace(";", " ").split() for line in data.decode("utf-8-sig").splitlines()]
    rows = [words for words in lines if words and not words[0].startswith(("#", "//"))]
    rows = rows[1:] if rows and not _is_number(rows[0][0]) else rows
    widths = {len(words) for words in rows}
    if rows and (min(widths) < 3 or not _is_number(rows[0][0])):
        raise InputError(
            f"{path}: not a cloud: expected x y z per line, found {' '.join(rows[0])[:60]!r}; known are PLY, PCD, OBJ and text"
        )
    if widths and widths <= {8, 12} and len(widths) == 1:
        raise InputError(f"{path}: {widths.pop()} numbers per line: a trajectory, not a cloud; give it as CLOUD,TRAJECTORY")
    return Geometry(np.array([words[:3] for words in rows], np.float64).reshape(-1, 3), NO_TRIANGLES)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
