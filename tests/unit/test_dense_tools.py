# SPDX-License-Identifier: Apache-2.0
"""The tools that export from a finished run, on a folder with a bumpy square before one camera."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from vitamin3d.dense.surface_extraction import vertex_normals
from vitamin3d.dense.tsdf_fusion import empty_surface
from vitamin3d.exporters.mesh import read_cloud_ply, read_ply, write_cloud_ply, write_ply
from vitamin3d.types import PointCloud, Surface

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
TOOLS = Path(__file__).parents[2] / "tools"
SIDE = 41


def tool(name):
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(tmp_path):
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE))
    vertices = np.column_stack([x.ravel(), y.ravel(), 2 + 0.05 * np.sin(5 * x.ravel())])
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    triangles = np.vstack([np.stack([corner, corner + SIDE, corner + 1], 1), np.stack([corner + 1, corner + SIDE, corner + SIDE + 1], 1)])
    colors = np.tile(np.array([[200, 100, 50]], np.uint8), (len(vertices), 1))
    surface = Surface(vertices, triangles.astype(np.int32), vertex_normals(vertices, triangles), colors)
    for name in ("mesh_high.ply", "mesh_low.ply"):
        write_ply(surface, tmp_path / name, ["lengths in metres"])
    (tmp_path / "keyframes.tum").write_text("".join(f"{k}.000000001 0 0 {0.1 * k} 0 0 0 1\n" for k in range(1, 4)))
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "canvas.yaml").write_text(
        "camera_model: pinhole\nintrinsics: [60.0, 60.0, 39.5, 29.5]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\nresolution: [80, 60]\n"
    )
    return tmp_path


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_every_format_can_be_opened(run, kind, capsys):
    import open3d as o3d

    assert tool("export_mesh").main([str(run), "--format", kind]) == 0
    path = Path(capsys.readouterr().out.strip())
    mesh = o3d.io.read_triangle_mesh(str(path))
    assert path == run / f"mesh_high_export.{kind}" and len(mesh.triangles) == 2 * (SIDE - 1) ** 2
    assert np.abs(np.asarray(mesh.vertex_colors) - np.array([200, 100, 50]) / 255).max() < 0.01
    assert np.sign(np.asarray(mesh.vertices)[:, 2].mean()) == (-1 if kind == "glb" else 1)
    assert kind == "glb" or b"lengths in metres" in path.read_bytes()[:400]


def test_an_empty_mesh_is_not_exported(run, capsys):
    write_ply(empty_surface(), run / "mesh_high.ply", [])
    assert tool("export_mesh").main([str(run)]) == 2
    assert "empty mesh" in capsys.readouterr().err and not (run / "mesh_high_export.ply").exists()


def test_simplified_meshes_with_many_borders_reach_the_number_and_keep_their_shape(run):
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


def test_simplified_meshes_keep_shape_and_colour(run):
    assert tool("export_mesh").main([str(run), "--simplify", "400", "--output", str(run / "small.ply")]) == 0
    small = read_ply(run / "small.ply")
    assert 200 < len(small.triangles) <= 400
    assert np.abs(small.vertices_world[:, 2] - 2 - 0.05 * np.sin(5 * small.vertices_world[:, 0])).max() < 0.02
    assert np.abs(small.colors.astype(int) - [200, 100, 50]).max() <= 1
    assert (small.normals_world[:, 2] < 0).all()


def test_small_holes_are_closed_and_the_rim_stays(run):
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


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_normal_maps_of_every_second_keyframe(run, frame):
    assert tool("export_normal_maps").main([str(run), "--every", "2", "--frame", frame, "--mesh", "low"]) == 0
    files = sorted((run / "normals_mesh_low").iterdir())
    assert [f.name for f in files] == ["1.000000001.png", "3.000000001.png"]
    blue, green, _ = cv2.imread(str(files[0]))[30, 40]
    assert (blue > 240) == (frame == "camera") and abs(int(green) - 128) <= 1
    assert (cv2.imread(str(files[0])) > 0).any(axis=2).mean() < (cv2.imread(str(files[1])) > 0).any(axis=2).mean() <= 1


MISTAKES = [["--output", "a.stl"], ["--simplify", "0"], ["--output", "missing/a.glb"], ["--output", "missing/a.ply"]]


@pytest.mark.parametrize("arguments", MISTAKES)
def test_mistakes_become_one_line(run, arguments, capsys, monkeypatch):
    monkeypatch.chdir(run)
    assert tool("export_mesh").main([str(run), *arguments]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("export_mesh: ")


def test_an_unfinished_run_is_refused(tmp_path, capsys):
    assert tool("export_normal_maps").main([str(tmp_path)]) == 2
    assert tool("export_mesh").main([str(tmp_path)]) == 2
    assert "mesh_high.ply" in capsys.readouterr().err


@pytest.fixture
def cloud(tmp_path):
    rng = np.random.default_rng(0)
    quality = (np.linspace(0, 20, 200), np.linspace(2, 0, 200), np.geomspace(1e-3, 1, 200))
    columns = (rng.integers(2, 20, 200).astype(np.int32), *(values.astype(np.float32) for values in quality))
    written = PointCloud(rng.random((200, 3)), rng.integers(0, 255, (200, 3)).astype(np.uint8), *columns)
    write_cloud_ply(written, tmp_path / "cloud.ply", ["lengths in metres"])
    return written


def test_clouds_are_filtered_by_their_properties(cloud, tmp_path, capsys):
    options = ["--min-parallax", "5", "--max-rms", "1", "--max-deviation", "0.5", "--min-observations", "6"]
    assert tool("filter_cloud").main([str(tmp_path / "cloud.ply"), str(tmp_path / "good.ply"), *options]) == 0
    good = (cloud.parallax_deg >= 5) & (cloud.reprojection_rms_px <= 1) & (cloud.depth_deviation <= 0.5) & (cloud.num_observations >= 6)
    read, comments = read_cloud_ply(tmp_path / "good.ply")
    assert f"{good.sum()} of 200 points" in capsys.readouterr().out and 20 < good.sum() < 150
    for name in ("points_world", "colors", "num_observations", "parallax_deg", "reprojection_rms_px", "depth_deviation"):
        np.testing.assert_allclose(getattr(read, name), getattr(cloud, name)[good], rtol=1e-6)
    assert comments[0] == "lengths in metres" and "parallax from 5 degrees" in comments[1]


def test_a_filter_that_leaves_nothing_and_foreign_clouds_are_refused(cloud, run, tmp_path, capsys):
    filter_cloud = tool("filter_cloud")
    assert filter_cloud.main([str(tmp_path / "cloud.ply"), str(tmp_path / "good.ply"), "--min-parallax", "90"]) == 2
    assert "loosen" in capsys.readouterr().err
    assert filter_cloud.main([str(run / "mesh_high.ply"), str(tmp_path / "good.ply")]) == 2
    assert "not a cloud that vitamin3d wrote" in capsys.readouterr().err
    assert filter_cloud.main([str(tmp_path / "none.ply"), str(tmp_path / "good.ply")]) == 2
    assert not (tmp_path / "good.ply").exists()


def test_the_speed_of_nltgv_is_told_with_the_energy(capsys):
    assert tool("benchmark_nltgv").main(["--vertices", "400", "--iterations", "300"]) == 0
    words = capsys.readouterr().out.split()
    assert words[0] == "400" and 1100 < int(words[2]) < 1200
    assert float(words[4]) > 100 and float(words[-1]) < float(words[-3])
