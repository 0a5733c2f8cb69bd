# SPDX-License-Identifier: Apache-2.0
"""The whole pipeline on the demo sequence, whose truth is exact: two-sided bounds, files, determinism."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import opened

from vitamin3d.config import Config, load_toml
from vitamin3d.datasets import open_dataset
from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.scale import match_timestamps

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "data" / "demo"


def vitamin3d(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "vitamin3d.cli", *arguments], capture_output=True, text=True, cwd=ROOT, check=False)


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """OUT of the demo, metric, threads on, with tracks."""
    out = tmp_path_factory.mktemp("demo") / "out"
    done = vitamin3d("reconstruct", str(DEMO), "-o", str(out), "--scale-from-ground-truth", "--save-tracks")
    assert done.returncode == 0, done.stderr
    return out


def test_trajectory_is_the_true_one(demo_run: Path) -> None:
    estimate, truth = read_tum(demo_run / "trajectory.tum"), open_dataset(DEMO).ground_truth()
    assert truth is not None
    i, j = match_timestamps(estimate.timestamps_ns, truth.timestamps_ns, tolerance_ns=0)
    a, b = estimate.T_world_cam[i, :3, 3], truth.T_world_cam[j, :3, 3]
    s, R, t = align_sim3(a, b)
    ate = float(np.sqrt(((s * a @ R.T + t - b) ** 2).sum(axis=1).mean()))
    assert len(i) >= 148
    assert 1e-5 < ate < 0.003
    assert s == pytest.approx(1.0, abs=1e-6)
    turns = [truth.T_world_cam[n, :3, :3].T @ R @ estimate.T_world_cam[m, :3, :3] for m, n in zip(i, j, strict=True)]
    degrees = [np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) for turn in turns]
    assert 0.0 < np.median(degrees) < 0.3


def test_without_a_mesh_the_trajectory_and_the_cloud_are_the_same(demo_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = vitamin3d("reconstruct", str(DEMO), "-o", str(out), "--scale-from-ground-truth", "--no-mesh")
    assert done.returncode == 0, done.stderr
    for name in ("trajectory.tum", "keyframes.tum", "cloud.ply"):
        assert (out / name).read_bytes() == (demo_run / name).read_bytes()
    assert not [name for name in ("mesh_high.ply", "mesh_low.ply", "mesh_high.obj", "depth", "normals") if (out / name).exists()]
    assert (out / "report.html").is_file() and json.loads((out / "stats.json").read_text())["empty_meshes"] == []


def test_surface_lies_on_the_true_one(demo_run: Path) -> None:
    import open3d as o3d

    estimate, truth = read_tum(demo_run / "trajectory.tum"), open_dataset(DEMO).ground_truth()
    assert truth is not None
    i, j = match_timestamps(estimate.timestamps_ns, truth.timestamps_ns, tolerance_ns=0)
    s, R, t = align_sim3(estimate.T_world_cam[i, :3, 3], truth.T_world_cam[j, :3, 3])
    scene = o3d.t.geometry.RaycastingScene()
    true_mesh = o3d.io.read_triangle_mesh(str(DEMO / "scene.ply"))
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(true_mesh))
    for name, bound in (("mesh_high", 0.025), ("mesh_low", 0.04)):
        points = s * read_ply(demo_run / f"{name}.ply").vertices_world @ R.T + t
        distance = scene.compute_distance(o3d.core.Tensor(points[::7].astype(np.float32))).numpy()
        assert 0.001 < np.median(distance) < bound, name
        assert (distance < 0.10).mean() > 0.9, name


def test_every_promised_file_is_there(demo_run: Path) -> None:
    names = {p.name for p in demo_run.iterdir()}
    expected = {"trajectory.tum", "keyframes.tum", "cloud.ply", "mesh_low.ply", "mesh_high.ply", "mesh_high.obj", "mesh_high.mtl"}
    assert names == expected | {"calibration.yaml", "config.toml", "stats.json", "tracks.npz", "report.html", "normals", "depth"}
    assert load_toml(demo_run / "config.toml") == Config()
    stamps = [line.split()[0] for line in (demo_run / "keyframes.tum").read_text().splitlines() if not line.startswith("#")]
    maps = {p.stem for p in (demo_run / "normals").glob("*.png")}
    assert len(maps) > 5 and maps <= set(stamps)
    assert maps == {p.stem for p in (demo_run / "depth").glob("*.png")}


def test_depth_and_normal_maps_fit_the_canvas(demo_run: Path) -> None:
    canvas = read_calibration(demo_run / "depth" / "canvas.yaml").camera
    name = sorted((demo_run / "depth").glob("*.png"))[3]
    depth, normals = cv2.imread(str(name), cv2.IMREAD_UNCHANGED), cv2.imread(str(demo_run / "normals" / name.name))
    assert depth.shape == (canvas.height, canvas.width) == normals.shape[:2]
    assert depth.dtype == np.uint16
    assert 1.0 < np.median(depth[depth > 0]) / 1000 < 5.0
    assert ((depth > 0) == (normals > 0).any(axis=-1)).mean() > 0.99


def test_statistics_tell_what_happened(demo_run: Path) -> None:
    stats = json.loads((demo_run / "stats.json").read_text())
    assert stats["frames"] == 150 and stats["unreadable_frames"] == 0 and not stats["interrupted"]
    assert stats["success_rate"] == pytest.approx(stats["tracked_frames"] / 150, abs=1e-6)
    assert stats["tracked_frames"] >= 148 and stats["keyframes"] > 10 and stats["cloud_points"] > 2000
    assert 1200 < stats["median_live_tracks"] <= 5300
    calibration = stats["calibration"]
    assert not calibration["refined"] and calibration["used"] == calibration["given"] and len(calibration["refinements"]) >= 1
    given = open_dataset(DEMO).camera
    assert read_calibration(demo_run / "calibration.yaml").camera == given
    assert stats["unit"] == "metre" and stats["voxels"]["high"] == pytest.approx(0.025)
    assert {"curvature_extrema", "track_extrema", "localize", "bundle_adjustment_keyframe", "denoising", "fusion_high"} <= set(
        stats["steps"]
    )
    assert stats["wall_seconds"] > 0 and stats["cpu_seconds"] > 0 and stats["peak_memory_mb"] > 100


def test_tracks_are_consistent(demo_run: Path) -> None:
    tracks = np.load(demo_run / "tracks.npz")
    frame, track = tracks["frame_index"], tracks["track_id"]
    assert len(frame) == len(track) == len(tracks["pixel"]) > 100_000
    assert len(np.unique(frame * (track.max() + 1) + track)) == len(frame)
    assert (tracks["pixel"] >= 0).all() and (tracks["pixel"] <= [479, 319]).all()


def test_mesh_opens_in_pymeshlab_with_colours_and_normals(demo_run: Path) -> None:
    import pymeshlab

    surface = read_ply(demo_run / "mesh_high.ply")
    for name in ("mesh_high.ply", "mesh_high.obj", "mesh_low.ply"):
        meshes = pymeshlab.MeshSet()
        meshes.load_new_mesh(str(demo_run / name))
        mesh = meshes.current_mesh()
        assert mesh.face_number() > 1000 and mesh.has_vertex_color(), name
        assert np.linalg.norm(mesh.vertex_normal_matrix(), axis=1).min() > 0, name
        assert mesh.vertex_color_matrix()[:, :3].std() > 0.05, name
        if name.startswith("mesh_high"):
            assert mesh.vertex_number() == len(surface.vertices_world), name


def test_cloud_opens_in_pymeshlab(demo_run: Path) -> None:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(demo_run / "cloud.ply"))
    assert meshes.current_mesh().vertex_number() == json.loads((demo_run / "stats.json").read_text())["cloud_points"]
    assert meshes.current_mesh().has_vertex_color()


def test_sequential_runs_are_bit_equal_and_threads_change_nothing(tmp_path: Path) -> None:
    for name, how in (("a", "--sequential"), ("b", "--sequential"), ("c", "--threads")):
        done = vitamin3d("reconstruct", str(DEMO), "-o", str(tmp_path / name), how, "--seed", "0", "--max-frames", "90", "--quiet")
        assert done.returncode == 0, done.stderr
    for file in ("trajectory.tum", "keyframes.tum", "cloud.ply", "mesh_low.ply", "mesh_high.ply"):
        first = (tmp_path / "a" / file).read_bytes()
        assert len(first) > 1000
        assert first == (tmp_path / "b" / file).read_bytes(), file
        assert first == (tmp_path / "c" / file).read_bytes(), file
    assert b"up to scale" in (tmp_path / "a" / "mesh_high.ply").read_bytes()[:600]


def test_paper_mode_runs(tmp_path: Path) -> None:
    done = vitamin3d("reconstruct", str(DEMO), "-o", str(tmp_path / "out"), "--mode", "paper", "--quiet")
    assert done.returncode == 0, done.stderr
    stats = json.loads((tmp_path / "out" / "stats.json").read_text())
    assert stats["mode"] == "paper" and stats["success_rate"] > 0.8


def test_pipeline_on_a_page_does_the_same_job(tmp_path: Path) -> None:
    command = [sys.executable, "pipelines/reconstruct.py", str(DEMO), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    other = vitamin3d("reconstruct", str(DEMO), "-o", str(tmp_path / "cli"), "--sequential", "--quiet")
    assert other.returncode == 0, other.stderr
    assert (tmp_path / "out" / "trajectory.tum").read_bytes() == (tmp_path / "cli" / "trajectory.tum").read_bytes()
    assert (tmp_path / "out" / "mesh_high.ply").read_bytes() == (tmp_path / "cli" / "mesh_high.ply").read_bytes()


@pytest.mark.browser
@pytest.mark.filterwarnings("ignore")
def test_the_report_opens_offline_in_a_browser(demo_run: Path) -> None:
    path = demo_run / "report.html"
    assert 1_000_000 < path.stat().st_size <= 15_000_000
    text = path.read_text()
    assert text.count("data:image/jpeg") == 12 and "after Sim(3)" in text and "curvature extrema" in text
    with opened(path) as page:
        picture = page.picture()
        assert page.evaluate("window.vitamin3dReport.triangles") > 50_000
        assert (picture.std(axis=-1) > 8).mean() > 0.1, "blank"
        page.drag("view", 200, 40)
        assert (page.picture() != picture).any(axis=-1).mean() > 0.1
        assert page.errors() == [] and page.requests() == []


@pytest.mark.parametrize(
    ("tool", "arguments", "made"),
    [
        ("export_mesh.py", ["--format", "obj", "--simplify", "5000"], "mesh_high_export.obj"),
        ("export_mesh.py", ["--format", "glb"], "mesh_high_export.glb"),
        ("export_normal_maps.py", ["--mesh", "low", "--every", "8"], None),
    ],
)
def test_tools_work_on_a_finished_run(demo_run: Path, tmp_path: Path, tool: str, arguments: list[str], made: str | None) -> None:
    import shutil

    out = shutil.copytree(demo_run, tmp_path / "out")
    done = subprocess.run([sys.executable, f"tools/{tool}", str(out), *arguments], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    if made is not None:
        assert (out / made).stat().st_size > 50_000
    else:
        assert sum(1 for _ in out.rglob("*.png")) > sum(1 for _ in demo_run.rglob("*.png"))


def test_mesh_can_be_drawn(demo_run: Path, tmp_path: Path) -> None:
    picture = tmp_path / "mesh.png"
    done = subprocess.run(
        [sys.executable, "tools/render_mesh.py", str(demo_run), str(picture), "--width", "400"], capture_output=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0
    pixels = cv2.imread(str(picture))
    assert pixels.shape[1] == 400 and 0.4 < (pixels < 250).any(axis=-1).mean() <= 1.0
