# SPDX-License-Identifier: Apache-2.0
"""Writes the mesh of a finished run in another format, or with fewer triangles.

    python tools/export_mesh.py OUT --format glb
    python tools/export_mesh.py OUT --mesh low --format obj --simplify 50000 --output small.obj

PLY and OBJ keep the map's frame (that of the first camera: x right, y down, z forward). GLB is turned upright, y up, as
glTF wants it. `--fill-holes` uses pymeshlab, which is under the GPL and is imported for this option only.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.dense.surface_extraction import vertex_normals
from vitamin3d.errors import DependencyError, InputError, OutputError, Vitamin3dError
from vitamin3d.exporters.mesh import read_comments, read_ply, write_obj, write_ply
from vitamin3d.types import Surface

GLTF_FROM_MAP = np.array([1.0, -1.0, -1.0])


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of a finished run")
    parser.add_argument("--mesh", choices=("low", "high"), default="high")
    parser.add_argument("--format", choices=("ply", "obj", "glb"), help="default: the ending of --output, else ply")
    parser.add_argument("--simplify", type=int, metavar="N", help="at most N triangles (quadric edge collapse)")
    parser.add_argument("--fill-holes", type=int, metavar="N", help="closes holes with at most N edges around them")
    parser.add_argument("--output", type=Path, help="default: mesh_<mesh>_export.<format> in OUT")
    return parser.parse_args(argv)


def export(arguments: argparse.Namespace) -> Path:
    """Reads, simplifies, writes; the path of the new file."""
    source = arguments.out / f"mesh_{arguments.mesh}.ply"
    surface = read_ply(source)
    if not len(surface.triangles):
        raise InputError(f"{source}: an empty mesh; reconstruct again")
    path, kind = _target(arguments)
    comments = [*read_comments(source), f"exported from {source.name}, which has {len(surface.triangles)} triangles"]
    if arguments.fill_holes is not None:
        surface = filled(surface, arguments.fill_holes)
    if arguments.simplify is not None:
        surface = simplified(surface, arguments.simplify)
    {"ply": write_ply, "obj": write_obj, "glb": write_glb}[kind](surface, path, comments)
    return path


def _target(arguments: argparse.Namespace) -> tuple[Path, str]:
    """Where to write, and in which format."""
    kind = arguments.format or (arguments.output.suffix[1:].lower() if arguments.output else "ply")
    if kind not in ("ply", "obj", "glb"):
        raise InputError(f"{arguments.output}: unknown ending; use .ply, .obj or .glb, or give --format")
    return arguments.output or arguments.out / f"mesh_{arguments.mesh}_export.{kind}", kind


def simplified(surface: Surface, max_triangles: int) -> Surface:
    """The surface with at most so many triangles, by Open3D's quadric edge collapse.

    Pymeshlab's, which keeps every edge of the many borders of a mesh from pictures, misses such numbers and bends the rest.
    """
    if max_triangles < 1:
        raise InputError(f"--simplify: must be positive, not {max_triangles}")
    if len(surface.triangles) <= max_triangles:
        return surface
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(surface.vertices_world), o3d.utility.Vector3iVector(surface.triangles))
    mesh.vertex_colors = o3d.utility.Vector3dVector(surface.colors / 255.0)
    mesh = mesh.simplify_quadric_decimation(max_triangles).remove_unreferenced_vertices()
    vertices, triangles = np.array(mesh.vertices), np.array(mesh.triangles, np.int32)
    if not 0 < len(triangles) <= max_triangles:
        raise InputError(f"--simplify {max_triangles}: {len(triangles)} triangles would be left; choose another number")
    colors = np.rint(255.0 * np.clip(np.array(mesh.vertex_colors), 0.0, 1.0)).astype(np.uint8)
    return Surface(vertices, triangles, vertex_normals(vertices, triangles), colors)


def filled(surface: Surface, max_edges: int) -> Surface:
    """The surface with its holes of at most so many edges closed; edges that more than two triangles share are cut before."""
    if max_edges < 3:
        raise InputError(f"--fill-holes {max_edges}: a hole has at least 3 edges")
    meshes = _mesh_set(surface, "--fill-holes")
    meshes.meshing_repair_non_manifold_edges()
    meshes.meshing_repair_non_manifold_vertices()
    meshes.meshing_close_holes(maxholesize=max_edges)
    return _surface(meshes)


def _mesh_set(surface: Surface, option: str) -> Any:
    """The surface as pymeshlab has it."""
    pymeshlab = _pymeshlab(option)
    rgba = np.column_stack([surface.colors / 255.0, np.ones(len(surface.colors))])
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(surface.vertices_world, surface.triangles, v_color_matrix=rgba))
    return meshes


def _surface(meshes: Any) -> Surface:
    mesh = meshes.current_mesh()
    vertices, triangles = np.array(mesh.vertex_matrix()), np.array(mesh.face_matrix(), np.int32)
    colors = np.rint(255.0 * mesh.vertex_color_matrix()[:, :3]).astype(np.uint8)
    return Surface(vertices, triangles, vertex_normals(vertices, triangles), colors)


def _pymeshlab(option: str):  # type: ignore[no-untyped-def]
    try:
        import pymeshlab
    except ImportError as error:
        raise DependencyError(f"{option} needs pymeshlab ({error}); `pip install pymeshlab`") from None
    return pymeshlab


def write_glb(surface: Surface, path: Path, comments: list[str]) -> None:
    """Binary glTF with colours and normals, y up; `comments` have no place in it. Open3D reports failure by its result alone."""
    import open3d as o3d

    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex.positions = o3d.core.Tensor((surface.vertices_world * GLTF_FROM_MAP).astype(np.float32))
    mesh.vertex.normals = o3d.core.Tensor((surface.normals_world * GLTF_FROM_MAP).astype(np.float32))
    mesh.vertex.colors = o3d.core.Tensor((surface.colors / 255.0).astype(np.float32))  # bytes come out as garbage
    mesh.triangle.indices = o3d.core.Tensor(surface.triangles)
    temporary = path.with_name(f".{path.stem}.tmp.glb")
    try:
        if not o3d.t.io.write_triangle_mesh(str(temporary), mesh) or not temporary.stat().st_size:
            raise OutputError(f"{path}: Open3D could not write it; free the disk or choose another --output")
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); free the disk or choose another --output") from None
    finally:
        if temporary.exists():
            temporary.unlink()


def main(argv: list[str] | None = None) -> int:
    try:
        print(export(parsed(argv)))
    except Vitamin3dError as error:
        print(f"export_mesh: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
