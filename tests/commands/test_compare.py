# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d compare` on the made-up run of conftest.py."""

import json

import cv2
import numpy as np
import pytest
import scenes

from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.evaluation.surface_error import sample_surface

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")]
DEMO = scenes.DEMO


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
    assert "MapPoints.txt: 1 points" in error and "--drop-outliers" in error and not (run / "comparison").exists()
    told = command("compare", run, other, "--drop-outliers")
    assert told.code == 0 and told.err.startswith("warning: ") and "MapPoints.txt: 1 points" in told.err
    assert items_of(run / "comparison")[1]["orbslam3/demo"]["outliers"] == 1


def test_a_stray_point_of_a_scan_is_an_error_too(run, other, command, tmp_path):
    np.savetxt(tmp_path / "scan.xyz", np.vstack([sample_surface(read_geometry(DEMO / "scene.ply"), 20_000), [[2000.0, 0, 0]]]))
    for name, rest in (("evaluate", ()), ("compare", (other,))):
        arguments = (name, run, *rest, "-g", DEMO, "--reference", tmp_path / "scan.xyz", "-o", tmp_path / name)
        error = command(*arguments).error
        assert "scan.xyz: 1 points" in error and "--drop-outliers" in error and not (tmp_path / name).exists()
        told = command(*arguments, "--drop-outliers")
        assert told.code == 0 and told.err.startswith("warning: ") and "scan.xyz: 1 points" in told.err


def test_clocks_that_do_not_overlap_are_said(run, other, command):
    lines = (other / "KeyFrameTrajectory.txt").read_text().splitlines()
    (other / "KeyFrameTrajectory.txt").write_text(
        "\n".join(f"{float(line.split()[0]) - 1.7e9:.6f} {line.split(' ', 1)[1]}" for line in lines)
    )
    error = command("compare", run, other).error
    assert "no overlap in time" in error and "KeyFrameTrajectory.txt covers" in error
