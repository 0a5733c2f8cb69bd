# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d compare`, `evaluate --surface` and `figures` on a made-up run of the demo: its true mesh, in another world and unit."""

import json

import cv2
import numpy as np
import pytest
import scenes

from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.evaluation.surface_error import sample_surface
from vitamin3d.exporters.mesh import write_ply
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.geometry.se3 import exp_so3
from vitamin3d.types import Surface, Trajectory

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
DEMO = scenes.DEMO


def moved(trajectory, points, scale, R, t):
    """A trajectory and points in another world."""
    poses = np.array(trajectory.T_world_cam)
    poses[:, :3, :3] = R @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ R.T + t
    return Trajectory(trajectory.timestamps_ns, poses), scale * points @ R.T + t


@pytest.fixture(scope="module")
def seen(demo):
    """Points of the true surface that the demo's depth maps saw, thinned."""
    from vitamin3d.evaluation.reference_surface import cloud_of_depth

    return cloud_of_depth(DEMO, demo, demo.ground_truth())


@pytest.fixture
def run(demo, seen, tmp_path):
    """A finished run: half the unit, turned; its mesh is the scene itself, its cloud a third of what was seen."""
    folder = tmp_path / "run"
    (folder / "depth").mkdir(parents=True)
    scene, R, t = read_geometry(DEMO / "scene.ply"), exp_so3(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, 3.0])
    trajectory, vertices = moved(demo.ground_truth(), scene.points, 0.5, R, t)
    colors = np.full((len(vertices), 3), 128, np.uint8)
    write_ply(
        Surface(vertices, scene.triangles.astype(np.int32), np.tile([0.0, 0, 1], (len(vertices), 1)), colors), folder / "mesh_high.ply", []
    )
    np.savetxt(folder / "cloud.xyz", moved(demo.ground_truth(), seen[::3], 0.5, R, t)[1])
    (folder / "cloud.ply").write_bytes(as_ply(moved(demo.ground_truth(), seen[::3], 0.5, R, t)[1]))
    write_tum(trajectory, folder / "trajectory.tum")
    write_tum(Trajectory(trajectory.timestamps_ns[::10], trajectory.T_world_cam[::10]), folder / "keyframes.tum")
    stats = {"frames": 150, "initialization_retries": 0, "scale": {"known": False, "source": ""}, "source": "demo"}
    (folder / "stats.json").write_text(json.dumps(stats))
    camera = demo.camera.canvas()
    (folder / "depth" / "canvas.yaml").write_text(
        f"camera_model: pinhole\nintrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\ndistortion_model: radial-tangential\n"
        f"distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\nresolution: [{camera.width}, {camera.height}]\n"
    )
    return folder


def as_ply(points):
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    return head.encode() + points.astype("<f4").tobytes()


@pytest.fixture
def other(demo, seen, tmp_path):
    """What another system left: a trajectory, and a tenth of the points, 1 cm off per axis, in a world of its own."""
    folder = tmp_path / "orbslam3" / "demo"
    folder.mkdir(parents=True)
    trajectory, points = moved(
        demo.ground_truth(),
        seen[::10] + 0.01 * np.random.default_rng(2).standard_normal(seen[::10].shape),
        3.0,
        exp_so3(np.array([1.0, 0.5, 0.1])),
        np.array([9.0, 8, 7]),
    )
    write_tum(trajectory, folder / "KeyFrameTrajectory.txt")
    np.savetxt(folder / "MapPoints.txt", points)
    return folder


def items_of(path):
    report = json.loads((path / "comparison.json").read_text())
    return report, {item["name"]: item for item in report["items"]}


def test_both_are_measured_against_the_truth(run, other, command):
    told = command("compare", run, other, "-g", DEMO)
    assert told.code == 0 and told.err == ""
    report, items = items_of(run / "comparison")
    ours, theirs = items["ours: cloud"], items["orbslam3/demo"]
    assert (report["unit"], report["world"], report["ours"]) == ("metre", "ground truth", "ours: mesh")
    assert ours["placed_by"] == theirs["placed_by"] == "trajectory" and theirs["ate_rmse"] < 1e-6
    assert ours["scale"] == pytest.approx(2.0, rel=0.003) and theirs["scale"] == pytest.approx(1 / 3, rel=0.01)
    assert ours["truth"]["accuracy_median"] < 0.002 < theirs["truth"]["accuracy_median"] < 0.021
    assert ours["truth"]["completeness_5cm"] > theirs["truth"]["completeness_5cm"] > 0.05
    assert ours["points"] == pytest.approx(3.3 * theirs["points"], rel=0.05)
    assert ours["density"]["points_per_m2"] == pytest.approx(3.3 * theirs["density"]["points_per_m2"], rel=0.5)
    assert theirs["coverage"]["of"] == "truth" and theirs["coverage"]["ours_only"] > 0.05 > theirs["coverage"]["its_only"]
    assert "coverage" not in ours
    for words in ("| ours: mesh |", "completeness 5 / 10 cm", "Unit: metre"):
        assert words in (run / "comparison" / "comparison.md").read_text() and words in told.out


def test_the_picture_shows_all_of_them(run, other, command):
    assert command("compare", run, other, "-g", DEMO, "--back", "0.5").code == 0
    picture = cv2.imread(str(run / "comparison" / "comparison.jpg"))
    panels = np.split(picture[26:, : 3 * 426 - 6], [423, 849], axis=1)
    drawn = [(panel < 200).any(axis=-1).mean() for panel in panels]
    assert picture.shape[1] == 1272 and min(drawn) > 0.01 and drawn[1] == max(drawn)


def test_without_a_truth_ours_is_the_world(run, other, command):
    assert command("compare", run, other).code == 0
    report, items = items_of(run / "comparison")
    assert (report["unit"], report["world"]) == ("map unit", "our run")
    theirs = items["orbslam3/demo"]
    assert theirs["scale"] == pytest.approx(0.5 / 3, rel=1e-6) and "truth" not in theirs
    assert theirs["mutual"]["its_median"] == pytest.approx(0.0, abs=0.011) and theirs["coverage"]["of"] == "voxels"
    assert "units" in (run / "comparison" / "comparison.md").read_text()


def test_a_cloud_without_a_trajectory_is_found_by_its_shape(run, other, command):
    told = command("compare", run, other / "MapPoints.txt", "--json")
    assert told.code == 0
    found = json.loads(told.out)["items"][-1]
    assert (found["name"], found["placed_by"]) == ("demo/MapPoints.txt", "registration")
    assert found["scale"] == pytest.approx(0.5 / 3, rel=0.05) and found["overlap"] > 0.7
    named = command("compare", run, f"{other / 'MapPoints.txt'},{other / 'KeyFrameTrajectory.txt'}", "--json")
    assert json.loads(named.out)["items"][-1]["placed_by"] == "trajectory"


def test_a_scanned_cloud_can_be_the_truth(run, other, command, tmp_path):
    np.savetxt(tmp_path / "scan.xyz", sample_surface(read_geometry(DEMO / "scene.ply"), 60_000))
    assert command("compare", run, other, "-g", DEMO, "--reference", tmp_path / "scan.xyz", "-o", tmp_path / "made").code == 0
    _, items = items_of(tmp_path / "made")
    assert items["ours: mesh"]["truth"]["completeness_5cm"] > 0.99
    assert {path.name for path in (tmp_path / "made").iterdir()} == {"comparison.json", "comparison.md", "comparison.jpg"}


# --- surface of a run ------------------------------------------------------------------------------------------------


def test_the_surface_of_a_run_is_scored_by_both_protocols(run, command):
    told = command("evaluate", run, "-g", DEMO, "--surface")
    assert told.code == 0
    found = json.loads((run / "evaluation" / "evaluation.json").read_text())["surface"]
    assert found["observed"]["points"] <= 1.01 * found["reference"]["points"] and "keyframes" in found["observed"]["how"]
    for kind in ("mesh", "cloud"):
        for protocol in ("all", "observed_by_keyframes"):
            assert found[kind][protocol]["completeness_10cm"] > 0.95
    assert found["cloud"]["all"]["accuracy_median"] < 0.001
    assert found["mesh"]["observed_by_keyframes"]["rmse_completion"] < 0.02
    assert "mesh, observed, trajectories" in told.out and "RMSE" in told.out


def test_the_scene_is_pruned_to_what_keyframes_saw(run, command, tmp_path):
    """Against the whole scene the cloud is incomplete, against what keyframes saw it is not."""
    told = command("evaluate", run, "-g", DEMO, "--reference", DEMO / "scene.ply", "--json")
    assert told.code == 0, told.err
    found = json.loads(told.out)["surface"]
    assert found["observed"]["points"] < 0.9 * found["reference"]["points"]
    assert found["cloud"]["observed_by_keyframes"]["completeness_10cm"] > found["cloud"]["all"]["completeness_10cm"] + 0.05


# --- mistakes --------------------------------------------------------------------------------------------------------


def test_mistakes_are_one_line(run, other, command, tmp_path):
    assert "nowhere" in command("compare", tmp_path / "nowhere", other).error
    assert "nowhere" in command("compare", run, tmp_path / "nowhere").error
    assert "--ground-truth" in command("compare", run, other, "--reference", DEMO / "scene.ply").error
    assert "folder" in command("evaluate", run / "trajectory.tum", "-g", DEMO, "--surface").error
    assert "folder" in command("evaluate", run, "-g", run / "trajectory.tum", "--surface").error
    (other / "MapPoints.txt").write_text("")
    assert "empty cloud" in command("compare", run, other).error
    (other / "MapPoints.txt").unlink()
    assert "no cloud" in command("compare", run, other).error
    for name in ("cloud.ply", "mesh_high.ply"):
        (run / name).unlink()
    assert "neither cloud.ply nor mesh_high.ply" in command("compare", run, DEMO / "scene.ply").error
    assert not (run / "comparison").exists()


def test_a_stray_point_is_an_error_unless_it_may_be_left_out(run, other, command):
    with (other / "MapPoints.txt").open("a") as file:
        file.write("20000 0 0\n")
    error = command("compare", run, other).error
    assert "MapPoints.txt: 1 points" in error and "--drop-strays" in error and not (run / "comparison").exists()
    told = command("compare", run, other, "--drop-strays")
    assert told.code == 0 and told.err.startswith("warning: ") and "MapPoints.txt: 1 points" in told.err
    assert items_of(run / "comparison")[1]["orbslam3/demo"]["strays"] == 1


def test_a_stray_point_of_a_scan_is_an_error_too(run, other, command, tmp_path):
    np.savetxt(tmp_path / "scan.xyz", np.vstack([sample_surface(read_geometry(DEMO / "scene.ply"), 20_000), [[2000.0, 0, 0]]]))
    for name, rest in (("evaluate", ()), ("compare", (other,))):
        arguments = (name, run, *rest, "-g", DEMO, "--reference", tmp_path / "scan.xyz", "-o", tmp_path / name)
        error = command(*arguments).error
        assert "scan.xyz: 1 points" in error and "--drop-strays" in error and not (tmp_path / name).exists()
        told = command(*arguments, "--drop-strays")
        assert told.code == 0 and told.err.startswith("warning: ") and "scan.xyz: 1 points" in told.err


def test_clocks_that_do_not_overlap_are_said(run, other, command):
    lines = (other / "KeyFrameTrajectory.txt").read_text().splitlines()
    (other / "KeyFrameTrajectory.txt").write_text(
        "\n".join(f"{float(line.split()[0]) - 1.7e9:.6f} {line.split(' ', 1)[1]}" for line in lines)
    )
    error = command("compare", run, other).error
    assert "no overlap in time" in error and "KeyFrameTrajectory.txt covers" in error


@pytest.fixture
def complete(run, demo):
    """The run with a coarse mesh and tracks: a row of ten in each frame."""
    (run / "mesh_low.ply").write_bytes((run / "mesh_high.ply").read_bytes())
    count = len(demo)
    pixels = np.tile(np.column_stack([np.linspace(60, 420, 10), np.full(10, 160.0)]), (count, 1)).astype(np.float32)
    np.savez_compressed(
        run / "tracks.npz", frame_index=np.repeat(np.arange(count), 10), track_id=np.tile(np.arange(10), count), pixel=pixels
    )
    return run


def test_figures_shows_extrema_points_mesh_and_normals_on_a_page(complete, other, command):
    told = command("figures", complete, other, "--source", DEMO, "--width", "240", "--without-picture")
    assert told.code == 0 and told.err == "" and str(complete / "figures.png") in told.out
    page = cv2.imread(str(complete / "figures.png"))
    panel = (page.shape[0] - 6) // 2 - 26
    top, bottom = page[26 : 26 + panel], page[-panel:]
    assert page.shape[1] == 3 * 246 - 6
    extrema, points, theirs = (top[:, k * 246 : k * 246 + 240].astype(int) for k in range(3))
    green = (extrema[..., 1] > extrema[..., 0] + 60) & (extrema[..., 1] > 150)
    assert 10 <= green.sum() < 200 and abs(np.nonzero(green)[0].mean() - panel / 2) < 4
    assert 0.01 < (theirs < 200).any(axis=-1).mean() < (points < 200).any(axis=-1).mean()
    mesh, fine, coarse = (bottom[:, k * 246 : k * 246 + 240].astype(int) for k in range(3))
    assert np.ptp(mesh, axis=-1).max() < 30 < np.ptp(fine, axis=-1).max()  # a grey mesh, coloured normals
    np.testing.assert_array_equal(fine, coarse)


def test_figures_without_source_and_as_jpeg(complete, command, tmp_path):
    assert command("figures", complete, "-o", tmp_path / "page.jpg", "--width", "100").code == 0
    assert cv2.imread(str(tmp_path / "page.jpg")).shape[1] == 3 * 106 - 6


@pytest.mark.parametrize(
    ("options", "words"),
    [(["--keyframe", "999"], "keyframes 0 to 14"), (["-o", "page.gif"], "page.gif"), (["--source", DEMO], "tracks.npz")],
)
def test_mistakes_of_figures_are_named(complete, command, options, words):
    (complete / "tracks.npz").unlink()
    told = command("figures", complete, *options)
    assert told.code == 2 and words in told.err and "Traceback" not in told.err
    assert not (complete / "figures.png").exists()
