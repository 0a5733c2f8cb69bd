# SPDX-License-Identifier: Apache-2.0
"""The programs in `pipelines/`, on the demo."""

import importlib.util
import re
import shutil
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from vitamin3d.datasets import open_dataset
from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.types import Trajectory

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "data" / "demo"
pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


def pipeline(name: str) -> ModuleType:
    """A program of the folder, loaded as it is run."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "pipelines" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `paper_figures` made of the demo."""
    out = tmp_path_factory.mktemp("pipelines") / "out"
    truth = open_dataset(DEMO).ground_truth()
    assert truth is not None
    poses = np.array(truth.T_world_cam)
    poses[:, 0, 3] += np.linspace(0, 0.3, len(poses)) ** 2
    other = out.with_name("other.tum")
    write_tum(Trajectory(truth.timestamps_ns, poses), other)
    assert pipeline("paper_figures").main([str(DEMO), str(out), str(other)]) == 0
    return out


def test_the_papers_figures(run: Path) -> None:
    picture = cv2.imread(str(run / "figure_3.jpg"))
    width = (picture.shape[1] + 6) // 3
    panels = [picture[26:340, k * width : (k + 1) * width - 6] for k in range(3)]
    colorful = [(np.ptp(panel.astype(int), axis=-1) > 60).mean() for panel in panels]
    assert picture.shape[1] == 3 * 486 - 6 and colorful[0] > 0.02 and colorful[2] > 0.1
    assert (panels[1] < 250).any(axis=-1).mean() > 0.02, "points"
    svg = (run / "figure_4.svg").read_text()
    assert svg.count("<polyline") == 2 and "other.tum" in svg


def test_compare_with_orbslam(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A made-up map of ORB-SLAM: our own, thinned, in another unit."""
    out, other = Path(shutil.copytree(run, tmp_path / "out")), tmp_path / "orbslam"
    other.mkdir()
    ours = read_tum(out / "keyframes.tum")
    poses = np.array(ours.T_world_cam)
    poses[:, :3, 3] *= 3.0
    write_tum(Trajectory(ours.timestamps_ns, poses), other / "KeyFrameTrajectory.txt")
    np.savetxt(other / "MapPoints.txt", 3.0 * read_geometry(out / "cloud.ply").points[::4])
    assert pipeline("compare_orbslam").main([str(DEMO), str(out), str(other)]) == 0
    rows = [line.strip("| ").split(" | ") for line in (out / "comparison.md").read_text().splitlines() if line.startswith("|")]
    points = [int(row[1].split()[0].replace(",", "")) for row in rows[2:]]
    assert rows[0][0] == "what" and [row[4] for row in rows[2:]] == ["trajectory"] * 3 and "cm" in rows[2][5]
    assert points[0] == pytest.approx(4 * points[2], abs=4) and "| ours: mesh |" in capsys.readouterr().out
    assert cv2.imread(str(out / "comparison.jpg")).shape[1] > 1000


def test_euroc_benchmark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(DEMO, tmp_path / "root" / "V1_01_easy", ignore=shutil.ignore_patterns("depth0", "scene.ply"))
    assert pipeline("euroc_benchmark").main([str(tmp_path / "root"), str(tmp_path / "out"), "1"]) == 0
    row = capsys.readouterr().out.splitlines()[2].strip("| ").split(" | ")
    assert row[0] == "V1_01_easy" and row[1].startswith("✓ 0.") and row[2] == "100.0 ± 0.0"
    assert (tmp_path / "out" / "V1_01_easy" / "0" / "report.html").is_file()
    assert pipeline("euroc_benchmark").main([str(tmp_path / "nothing"), str(tmp_path / "out")]) == 2


def test_a_step_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The beginning of the demo is tracked both ways."""
    short = Path(shutil.copytree(DEMO, tmp_path / "short", ignore=shutil.ignore_patterns("depth0", "scene.ply")))
    table = short / "mav0" / "cam0" / "data.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:71]))  # a line of names, then the pictures
    assert pipeline("own_step").main([str(short)]) == 0
    said = capsys.readouterr().out.splitlines()
    found = [re.fullmatch(r"(.+): (\d+) of 70 frames localised, maps: 1, landmarks: (\d+)", line) for line in said]
    (_, frames, landmarks), (_, frames_klt, landmarks_klt) = rows = [row.groups() for row in found if row is not None]
    assert [name for name, *_ in rows] == ["hill climbing", "KLT"] and int(frames) >= 65 and int(frames_klt) >= 65
    assert int(landmarks) > 1000 and int(landmarks_klt) > 1000 and landmarks != landmarks_klt
    assert pipeline("own_step").main([]) == 2 and "python pipelines/own_step.py" in capsys.readouterr().out
