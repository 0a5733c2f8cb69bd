# SPDX-License-Identifier: Apache-2.0
"""Surfaces and clouds as PLY (binary) and OBJ (text), each file complete or absent."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.errors import InputError
from vitamin3d.exporters.files import write_file
from vitamin3d.types import Array, PointCloud, Surface

POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
VERTEX = np.dtype([(n, "<f4") for n in POSITION + NORMAL] + [(n, "u1") for n in COLOR])
FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])
CLOUD = np.dtype(
    [(n, "<f4") for n in POSITION]
    + [(n, "u1") for n in COLOR]
    + [("num_observations", "<i4")]
    + [(n, "<f4") for n in ("parallax_deg", "reprojection_rms_px", "depth_deviation")]
)
QUALITY = ("num_observations", "parallax_deg", "reprojection_rms_px", "depth_deviation")
PLY_NAMES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
CHUNK_LINES = 20_000
MAX_FACE_LINE = len("f" + 3 * " 2147483648//2147483648" + "\n")
MATERIAL = b"newmtl vertex_colors\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\n"


def write_ply(surface: Surface, path: Path, comments: list[str]) -> None:
    """Binary little-endian PLY with vertex normals, colours and triangles.

    Args:
        comments: each becomes a `comment` line of the header.

    Raises:
        OutputError: the file cannot be written.
    """
    vertices = np.empty(len(surface.vertices_world), VERTEX)
    _fill(vertices, POSITION, surface.vertices_world)
    _fill(vertices, NORMAL, surface.normals_world)
    _fill(vertices, COLOR, surface.colors)
    faces = np.empty(len(surface.triangles), FACE)
    faces["count"] = 3
    faces["vertex_indices"] = surface.triangles
    write_file(path, [_header(vertices, comments, _face_lines(len(faces))), vertices.tobytes(), faces.tobytes()])


def write_cloud_ply(cloud: PointCloud, path: Path, comments: list[str]) -> None:
    """Binary little-endian PLY of the points with their colours and quality, one property each.

    Raises:
        OutputError: the file cannot be written.
    """
    points = np.empty(len(cloud.points_world), CLOUD)
    _fill(points, POSITION, cloud.points_world)
    _fill(points, COLOR, cloud.colors)
    for name in QUALITY:
        points[name] = getattr(cloud, name)
    write_file(path, [_header(points, comments, []), points.tobytes()])


def read_cloud_ply(path: Path) -> tuple[PointCloud, list[str]]:
    """A cloud that `write_cloud_ply` wrote, and its comments.

    Raises:
        InputError: the file cannot be read, or is another kind of PLY.
    """
    table, _, comments = _read_own(path, "cloud", CLOUD)
    points, colors = (np.stack([table[n] for n in names], axis=1) for names in (POSITION, COLOR))
    quality = (np.array(table[name]) for name in QUALITY)
    return PointCloud(points.astype(np.float64), colors, *quality), comments


def _read_own(path: Path, what: str, vertex: Any) -> tuple[Array, Array, list[str]]:
    """Vertices, faces and comments of a PLY just as this file writes it; a cloud has no faces."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    header, _, body = data.partition(b"end_header\n")
    lines = header.decode("ascii", "replace").splitlines()
    num_vertices, num_faces = _element_count(lines, "vertex"), _element_count(lines, "face")
    faces = [] if vertex is CLOUD else _face_lines(num_faces)
    expected = _header(np.empty(num_vertices, vertex), [], faces).decode().splitlines()[:-1]
    size = num_vertices * vertex.itemsize
    if [line for line in lines if not line.startswith("comment ")] != expected or len(body) != size + num_faces * FACE.itemsize:
        raise InputError(f"{path}: not a {what} that vitamin3d wrote, or cut short; write it again")
    comments = [line[8:] for line in lines if line.startswith("comment ")]
    return np.frombuffer(body[:size], vertex), np.frombuffer(body[size:], FACE), comments


def write_obj(surface: Surface, path: Path, comments: list[str]) -> None:
    """Text OBJ with vertex colours (`v x y z r g b`, as MeshLab and Blender read them) and normals.

    Its material, in an MTL of the same name beside it, is white and matt, so that it leaves the colours as they are.

    Raises:
        OutputError: a file cannot be written.
    """
    material = path.with_suffix(".mtl")
    write_file(material, [MATERIAL])
    write_file(path, obj_text(surface, comments, material.name))


def read_ply(path: Path) -> Surface:
    """A surface that `write_ply` wrote.

    Raises:
        InputError: the file cannot be read, or is another kind of PLY.
    """
    vertices, faces, _ = _read_own(path, "mesh", VERTEX)
    points, normals, colors = (np.stack([vertices[n] for n in names], axis=1) for names in (POSITION, NORMAL, COLOR))
    return Surface(points.astype(np.float64), faces["vertex_indices"].astype(np.int32), normals.astype(np.float64), colors)


def read_comments(path: Path) -> list[str]:
    """The comments of a PLY's header: scale, voxels, filter and version, as `write_ply` got them."""
    with path.open("rb") as file:
        header = file.read(10_000).partition(b"end_header\n")[0]
    return [line[8:] for line in header.decode("ascii", "replace").splitlines() if line.startswith("comment ")]


def _element_count(lines: list[str], name: str) -> int:
    """Number of elements that a header declares; 0 where it declares none."""
    words = next((line.split() for line in lines if line.startswith(f"element {name} ")), [])
    return int(words[2]) if len(words) == 3 and words[2].isdigit() else 0


def _fill(table: Array, names: tuple[str, ...], columns: Array) -> None:
    for k, name in enumerate(names):
        table[name] = columns[:, k]


def _face_lines(count: int) -> list[str]:
    return [f"element face {count}", "property list uchar int vertex_indices"]


def _header(vertices: Array, comments: list[str], face_lines: list[str]) -> bytes:
    columns = [(name, PLY_NAMES[vertices.dtype[name].str]) for name in vertices.dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for comment in comments for line in comment.splitlines()]
    lines += [f"element vertex {len(vertices)}"]
    lines += [f"property {kind} {name}" for name, kind in columns]
    return "\n".join([*lines, *face_lines, "end_header\n"]).encode("ascii", "replace")


def obj_text(surface: Surface, comments: list[str], material: str) -> Iterator[bytes]:
    """What `write_obj` writes, part by part; `material` is the name of its MTL."""
    yield "".join(f"# {line}\n" for comment in comments for line in comment.splitlines()).encode()
    yield f"mtllib {material}\n".encode()
    yield from _lines("v %.6g %.6g %.6g %.4g %.4g %.4g\n", np.hstack([surface.vertices_world, surface.colors / 255.0]))
    yield from _lines("vn %.4g %.4g %.4g\n", surface.normals_world)
    yield b"usemtl vertex_colors\n"
    for start in range(0, len(surface.triangles), CHUNK_LINES):
        yield _faces(surface.triangles[start : start + CHUNK_LINES])


def _lines(pattern: str, rows: Array) -> Iterator[bytes]:
    """The rows (N, C) through a % pattern, in chunks: one formatting call each, many times faster than `savetxt`."""
    for start in range(0, len(rows), CHUNK_LINES):
        chunk = rows[start : start + CHUNK_LINES]
        yield ((pattern * len(chunk)) % tuple(chunk.ravel().tolist())).encode()


def _faces(triangles: Array) -> bytes:
    """Lines `f a//a b//b c//c` of triangles (N, 3), vertices counted from one."""
    out = np.empty(len(triangles) * MAX_FACE_LINE, np.uint8)
    return out[: _write_faces(np.ascontiguousarray(triangles, np.int32), out)].tobytes()


@kernel
def _write_faces(triangles, out):  # type: ignore[no-untyped-def]
    """The text of `_faces`; how many bytes."""
    at, digits = 0, np.empty(10, np.uint8)
    for n in range(triangles.shape[0]):
        out[at] = ord("f")
        at += 1
        for k in range(3):
            count, rest = 0, np.int64(triangles[n, k]) + 1
            while rest > 0:
                digits[count] = ord("0") + rest % 10
                count, rest = count + 1, rest // 10
            for mark in (" ", "//"):
                for character in mark:
                    out[at] = ord(character)
                    at += 1
                for d in range(count - 1, -1, -1):
                    out[at] = digits[d]
                    at += 1
        out[at] = ord("\n")
        at += 1
    return at
