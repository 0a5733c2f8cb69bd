# SPDX-License-Identifier: Apache-2.0
"""Clouds and meshes of any system: PLY, PCD, OBJ, and text (`MapPoints.txt`, xyz), as numbers and without a library."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.errors import InputError
from vitamin3d.types import Array

SUFFIXES = (".ply", ".pcd", ".obj", ".txt", ".xyz", ".csv", ".asc", ".pts")
PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"), **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"), **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
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
    except (ValueError, IndexError, KeyError, UnicodeDecodeError, OverflowError):
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


# --- PLY -------------------------------------------------------------------------------------------------------------


@dataclass
class _Element:
    """A table of a PLY: `vertex`, `face` or another."""

    name: str
    count: int
    properties: list[tuple[str, str, str]]
    """Name, type, and the type of the length for a list, else empty."""


def _read_ply(path: Path, data: bytes) -> Geometry:
    header, _, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not body:
        raise InputError(f"{path}: not a PLY file; name it by its format, or export it again")
    order, elements = _ply_header(path, header.decode("ascii", "replace").splitlines())
    body = body[body.index(b"\n") + 1 :]
    tables = _ply_text(body, elements) if order == "" else _ply_binary(body, elements, order)
    if "vertex" not in tables or not {"x", "y", "z"} <= set(tables["vertex"]):
        raise InputError(f"{path}: no vertices with x, y and z; export it again")
    vertex = tables["vertex"]
    points = np.stack([vertex[c] for c in "xyz"], axis=1).astype(np.float64)
    faces = next((column for name, column in tables.get("face", {}).items() if name.startswith("vertex_ind")), NO_TRIANGLES)
    return Geometry(points, _checked(faces, len(points)), _colors(vertex))


def _ply_header(path: Path, lines: list[str]) -> tuple[str, list[_Element]]:
    order, elements = None, list[_Element]()
    for words in (line.split() for line in lines):
        if words[:1] == ["format"]:
            order = PLY_ORDERS[words[1]]
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            elements[-1].properties.append((words[4], PLY_TYPES[words[3]], PLY_TYPES[words[2]]))
        elif words[:1] == ["property"]:
            elements[-1].properties.append((words[2], PLY_TYPES[words[1]], ""))
    if order is None or not elements:
        raise InputError(f"{path}: a PLY without a header that is known; export it again")
    return order, elements


def _ply_binary(body: bytes, elements: list[_Element], order: str) -> dict[str, dict[str, Array]]:
    tables, start = {}, 0
    for element in elements:
        lists = [p for p in element.properties if p[2]]
        if not lists:
            kind = np.dtype([(name, order + code) for name, code, _ in element.properties])
            rows = np.frombuffer(body, kind, element.count, start)
            start += kind.itemsize * element.count
            tables[element.name] = {name: rows[name] for name, *_ in element.properties}
        elif element.name == "face" or element is not elements[-1]:
            tables[element.name], start = _ply_lists(body, element, order, start)
    return tables


def _ply_lists(body: bytes, element: _Element, order: str, start: int) -> tuple[dict[str, Array], int]:
    """Rows with lists: at once where all lists are triangles, else row by row, larger polygons as fans."""
    fields: list[Any] = []
    for name, code, length in element.properties:
        fields += [(f"{name} count", order + length), (name, order + code, (3,))] if length else [(name, order + code)]
    kind = np.dtype(fields)
    if start + kind.itemsize * element.count <= len(body):
        rows = np.frombuffer(body, kind, element.count, start)
        if all((rows[f"{name} count"] == 3).all() for name, _, length in element.properties if length):
            return {name: rows[name] for name, *_ in element.properties}, start + kind.itemsize * element.count
    fans, position = list[list[int]](), start
    for _ in range(element.count):
        for name, code, length in element.properties:
            count = 1
            if length:
                count = int(np.frombuffer(body, order + length, 1, position)[0])
                position += np.dtype(length).itemsize
            values = np.frombuffer(body, order + code, count, position)
            position += np.dtype(code).itemsize * count
            fans += _fan(values.tolist()) if name.startswith("vertex_ind") else []
    return {"vertex_indices": np.array(fans, np.int64).reshape(-1, 3)}, position


def _fan(polygon: list[int]) -> list[list[int]]:
    return [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]


def _ply_text(body: bytes, elements: list[_Element]) -> dict[str, dict[str, Array]]:
    rows, start = [line for line in body.splitlines() if line.strip()], 0
    tables: dict[str, dict[str, Array]] = {}
    for element in elements:
        mine = rows[start : start + element.count]
        if len(mine) < element.count:
            raise ValueError("cut short")
        if any(length for *_, length in element.properties):
            polygons = [[int(float(word)) for word in row.split()] for row in mine]
            fans = [triangle for row in polygons for triangle in _fan(row[1 : 1 + row[0]])]
            tables[element.name] = {element.properties[0][0]: np.array(fans, np.int64).reshape(-1, 3)}
        elif mine:
            values = np.array([row.split()[: len(element.properties)] for row in mine], np.float64)
            tables[element.name] = {name: values[:, k] for k, (name, *_) in enumerate(element.properties)}
        else:
            tables[element.name] = {name: np.zeros(0) for name, *_ in element.properties}
        start += element.count
    return tables


def _colors(vertex: dict[str, Array]) -> Array | None:
    for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        if set(names) <= set(vertex):
            values = np.stack([vertex[name] for name in names], axis=1)
            scale = 255.0 if values.dtype.kind == "f" and values.max(initial=0) <= 1.0 else 1.0
            return np.asarray(np.clip(values * scale, 0, 255).astype(np.uint8))
    return None


def _checked(triangles: Array, count: int) -> Array:
    triangles = np.asarray(triangles, np.int64).reshape(-1, 3)
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < count):
        raise ValueError("a triangle of a vertex that is not there")
    return triangles


# --- PCD -------------------------------------------------------------------------------------------------------------


def _read_pcd(path: Path, data: bytes) -> Geometry:
    head = data[: data.index(b"\n", data.index(b"DATA ")) + 1]
    fields = {words[0]: words[1:] for words in (line.split() for line in head.decode("ascii", "replace").splitlines()) if words}
    names, count = fields["FIELDS"], int(fields["POINTS"][0])
    kinds = [f"{ {'F': 'f', 'U': 'u', 'I': 'i'}[t] }{size}" for t, size in zip(fields["TYPE"], fields["SIZE"], strict=True)]
    repeats = [int(n) for n in fields.get("COUNT", ["1"] * len(names))]
    body, how = data[len(head) :], fields["DATA"][0]
    dtype = np.dtype([(f"{name} {k}", kind, (repeat,)) for k, (name, kind, repeat) in enumerate(zip(names, kinds, repeats, strict=True))])
    if how == "ascii":
        rows = np.array([line.split() for line in body.splitlines() if line.strip()][:count], np.float64)
        starts = np.cumsum([0, *repeats])
        columns = {name: rows[:, starts[k]] for k, name in enumerate(names)} if len(rows) else {name: np.zeros(0) for name in names}
    elif how == "binary":
        table = np.frombuffer(body, dtype, count)
        columns = {name: table[f"{name} {k}"][:, 0] for k, name in enumerate(names)}
    else:
        columns = _pcd_compressed(body, names, kinds, repeats, count)
    if not {"x", "y", "z"} <= set(columns):
        raise InputError(f"{path}: no fields x, y and z; export it again")
    return Geometry(np.stack([columns[c] for c in "xyz"], axis=1).astype(np.float64), NO_TRIANGLES, None)


def _pcd_compressed(body: bytes, names: list[str], kinds: list[str], repeats: list[int], count: int) -> dict[str, Array]:
    """PCL's `binary_compressed`: the columns one after the other, packed by LZF."""
    packed, size = (int(n) for n in np.frombuffer(body, "<u4", 2))
    raw, columns, start = _lzf(body[8 : 8 + packed], size), {}, 0
    for name, kind, repeat in zip(names, kinds, repeats, strict=True):
        columns[name] = np.frombuffer(raw, kind, count * repeat, start)[::repeat]
        start += np.dtype(kind).itemsize * count * repeat
    return columns


def _lzf(packed: bytes, size: int) -> bytes:
    out, k = bytearray(), 0
    while k < len(packed):
        control = packed[k]
        k += 1
        if control < 32:  # so many bytes as they are, and one
            out += packed[k : k + control + 1]
            k += control + 1
            continue
        length = control >> 5  # a copy of what came before
        if length == 7:
            length += packed[k]
            k += 1
        start = len(out) - ((control & 31) << 8) - packed[k] - 1
        k += 1
        for n in range(length + 2):
            out.append(out[start + n])
    if len(out) != size:
        raise ValueError("cut short")
    return bytes(out)


# --- OBJ and text ----------------------------------------------------------------------------------------------------


def _read_obj(path: Path, data: bytes) -> Geometry:
    points, triangles = [], list[list[int]]()
    for line in data.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.split("/")[0]) for word in words[1:]]
            triangles += _fan([c - 1 if c > 0 else len(points) + c for c in corners])
    return Geometry(np.array(points, np.float64).reshape(-1, 3), _checked(np.array(triangles).reshape(-1, 3), len(points)))


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
