# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from vitamin3d.dense.tsdf_fusion import empty_surface
from vitamin3d.exporters.mesh import read_ply, write_ply
from vitamin3d.types import Surface

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
SIDE = 41  # as in conftest.py


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_every_format_can_be_opened(tool, run, kind, capsys):
    import open3d as o3d

    assert tool("export_mesh").main([str(run), "--format", kind]) == 0
    path = Path(capsys.readouterr().out.strip())
    mesh = o3d.io.read_triangle_mesh(str(path))
    assert path == run / f"mesh_high_export.{kind}" and len(mesh.triangles) == 2 * (SIDE - 1) ** 2
    assert np.abs(np.asarray(mesh.vertex_colors) - np.array([200, 100, 50]) / 255).max() < 0.01
    assert np.sign(np.asarray(mesh.vertices)[:, 2].mean()) == (-1 if kind == "glb" else 1)
    assert kind == "glb" or b"lengths in metres" in path.read_bytes()[:400]


def test_an_empty_mesh_is_not_exported(tool, run, capsys):
    write_ply(empty_surface(), run / "mesh_high.ply", [])
    assert tool("export_mesh").main([str(run)]) == 2
    assert "empty mesh" in capsys.readouterr().err and not (run / "mesh_high_export.ply").exists()


def test_simplified_meshes_with_many_borders_reach_the_number_and_keep_their_shape(tool, run):
    """As meshes from pictures are: a tenth of the triangles is missing."""
    whole = read_ply(run / "mesh_high.ply")
    torn = whole.triangles[np.random.default_rng(0).random(len(whole.triangles)) > 0.1]
    write_ply(Surface(whole.vertices_world, torn, whole.normals_world, whole.colors), run / "mesh_high.ply", [])
    assert tool("export_mesh").main([str(run), "--simplify", "400", "--output", str(run / "small.ply")]) == 0
    small = read_ply(run / "small.ply")
    assert 200 < len(small.triangles) <= 400
    assert np.abs(small.vertices_world[:, 2] - 2 - 0.05 * np.sin(5 * small.vertices_world[:, 0])).max() < 0.03
    edges = np.sort(small.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2, "no edge has three triangles"


def test_simplified_meshes_keep_shape_and_colour(tool, run):
    assert tool("export_mesh").main([str(run), "--simplify", "400", "--output", str(run / "small.ply")]) == 0
    small = read_ply(run / "small.ply")
    assert 200 < len(small.triangles) <= 400
    assert np.abs(small.vertices_world[:, 2] - 2 - 0.05 * np.sin(5 * small.vertices_world[:, 0])).max() < 0.02
    assert np.abs(small.colors.astype(int) - [200, 100, 50]).max() <= 1
    assert (small.normals_world[:, 2] < 0).all()


def test_small_holes_are_closed_and_the_rim_stays(tool, run):
    pytest.importorskip("pymeshlab")
    whole = read_ply(run / "mesh_high.ply")
    centers = whole.vertices_world[whole.triangles].mean(axis=1)[:, :2]
    torn = Surface(whole.vertices_world, whole.triangles[np.abs(centers).max(axis=1) > 0.11], whole.normals_world, whole.colors)
    write_ply(torn, run / "mesh_high.ply", [])
    assert tool("export_mesh").main([str(run), "--fill-holes", "30", "--output", str(run / "filled.ply")]) == 0
    mended = read_ply(run / "filled.ply")
    assert len(torn.triangles) < len(mended.triangles) <= len(whole.triangles)
    middle = np.abs(mended.vertices_world[mended.triangles].mean(axis=1)[:, :2]).max(axis=1) < 0.08
    assert middle.any() and np.abs(mended.vertices_world[:, :2]).max() == pytest.approx(1.0)
    assert tool("export_mesh").main([str(run), "--fill-holes", "2"]) == 2


MISTAKES = [["--output", "a.stl"], ["--simplify", "0"], ["--output", "missing/a.glb"], ["--output", "missing/a.ply"]]


@pytest.mark.parametrize("arguments", MISTAKES)
def test_mistakes_become_one_line(tool, run, arguments, capsys, monkeypatch):
    monkeypatch.chdir(run)
    assert tool("export_mesh").main([str(run), *arguments]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("export_mesh: ")


def test_an_unfinished_run_is_refused(tool, tmp_path, capsys):
    assert tool("export_normal_maps").main([str(tmp_path)]) == 2
    assert tool("export_mesh").main([str(tmp_path)]) == 2
    assert "mesh_high.ply" in capsys.readouterr().err
