# SPDX-License-Identifier: Apache-2.0
"""Runs of which more than one map comes: a film that is cut half way, and one that begins with something else."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from vitamin3d.config import Config, live_config
from vitamin3d.datasets import open_dataset
from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import WorkerError
from vitamin3d.evaluation.trajectory_error import Alignment, absolute_errors, summarize
from vitamin3d.exporters.output_folder import OutputFolder
from vitamin3d.job import Job, Outcome, reconstruct_sequence
from vitamin3d.map_output import MapOutput
from vitamin3d.runtime import SilentObserver
from vitamin3d.scale import match_timestamps
from vitamin3d.types import Array, DepthView, Frame, Trajectory

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "data" / "demo"
CUT, GOES_ON = 60, 80
"""So many frames of the demo, then those from the second number on by a camera upside down."""
MESHES = {"mesh_low.ply", "mesh_high.ply", "mesh_high.obj", "mesh_high.mtl"}
FILES = MESHES | {"trajectory.tum", "keyframes.tum", "cloud.ply", "calibration.yaml"}
QUICK = dataclasses.replace(Config(), densification=dataclasses.replace(Config().densification, enabled=False))
pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


class CutFilm:
    """The demo, cut; a picture upside down has its camera in the same place."""

    name, remarks = "cut film", ()

    def __init__(self, demo: Dataset) -> None:
        self.demo, self.camera = demo, demo.camera
        self.sources = [*range(CUT), *range(GOES_ON, len(demo))]
        self.timestamps_ns = demo.timestamps_ns[: len(self.sources)]

    def __len__(self) -> int:
        return len(self.sources)

    def read(self, index: int) -> Frame | Unreadable:
        frame = self.demo.read(self.sources[index])
        if isinstance(frame, Unreadable):
            return frame
        image, color = (p if index < CUT or p is None else np.ascontiguousarray(p[::-1, ::-1]) for p in (frame.image, frame.color))
        assert image is not None
        return dataclasses.replace(frame, index=index, timestamp_ns=int(self.timestamps_ns[index]), image=image, color=color)

    def ground_truth(self) -> Trajectory:
        truth = self.demo.ground_truth()
        assert truth is not None
        rows, found = match_timestamps(self.demo.timestamps_ns[self.sources], truth.timestamps_ns)
        return Trajectory(self.timestamps_ns[rows], truth.T_world_cam[found])


@pytest.fixture(scope="module")
def film() -> CutFilm:
    return CutFilm(open_dataset(DEMO))


def reconstruct(film: CutFilm, job: Job, out: Path) -> Outcome:
    return reconstruct_sequence(film, job, OutputFolder(out), SilentObserver())  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def runs(film: CutFilm, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Outcome]]:
    """The cut film with metric maps, by name of the way of running."""
    made = {}
    for name in ("sequential", "threads"):
        out = tmp_path_factory.mktemp("maps") / name
        made[name] = out, reconstruct(film, Job(QUICK, threads=name == "threads", scale_from_truth=True), out)
    return made


def stamps(folder: Path) -> Array:
    return read_tum(folder / "trajectory.tum").timestamps_ns


def views(folder: Path) -> Iterator[int]:
    """Times of the depth maps, each of which has a normal map."""
    names = {path.name for path in (folder / "depth").glob("*.png")}
    assert names and names == {path.name for path in (folder / "normals").glob("*.png")} and (folder / "depth" / "canvas.yaml").is_file()
    return (int(name.removesuffix(".png").replace(".", "")) for name in names)


def test_each_map_has_its_files_and_its_frames(film: CutFilm, runs: dict[str, tuple[Path, Outcome]]) -> None:
    out, outcome = runs["threads"]
    second = out / "maps" / "2"
    assert {path.name for path in second.iterdir()} == FILES | {"depth", "normals"}
    assert {path.name for path in out.iterdir()} == FILES | {"depth", "normals", "maps", "stats.json", "config.toml", "report.html"}
    later, earlier = stamps(out), stamps(second)
    assert len(later) > len(earlier) >= CUT - 2 and len(later) >= len(film) - CUT - 2
    assert earlier.max() < film.timestamps_ns[CUT] <= later.min()
    for folder, frames in ((out, later), (second, earlier)):
        assert set(views(folder)) <= set(frames.tolist())
    assert "map 2 of the run" in (second / "trajectory.tum").read_text() and "map 2" not in (out / "trajectory.tum").read_text()
    assert outcome.has_map and "<h2>Maps</h2>" in (out / "report.html").read_text()


def test_statistics_count_all_maps(runs: dict[str, tuple[Path, Outcome]]) -> None:
    out, outcome = runs["threads"]
    stats = json.loads((out / "stats.json").read_text())
    first, second = stats["maps"]
    assert (first["number"], first["folder"], second["number"], second["folder"]) == (1, ".", 2, "maps/2")
    assert (first["birth"], second["birth"]) == (1, 0)
    assert first["frames"] == len(stamps(out)) and second["frames"] == len(stamps(out / "maps/2"))
    assert stats["tracked_frames"] == first["frames"] + second["frames"]
    assert stats["success_rate"] == pytest.approx(stats["tracked_frames"] / stats["frames"], abs=1e-6)
    assert all(stats[name] == first[name] for name in ("keyframes", "landmarks", "cloud_points", "voxels", "scale"))
    assert first["keyframes"] == len(stamps_of_keyframes(out)) and second["keyframes"] == len(stamps_of_keyframes(out / "maps/2"))
    assert second["last_frame_s"] < first["first_frame_s"] < first["last_frame_s"]
    assert stats["state"] == "tracking" and all(value > 0 for value in stats["frame_milliseconds"].values())
    assert outcome.stats["maps"] == stats["maps"]


def stamps_of_keyframes(folder: Path) -> Array:
    return read_tum(folder / "keyframes.tum").timestamps_ns


def test_each_map_has_a_scale_of_its_own_from_the_truth(film: CutFilm, runs: dict[str, tuple[Path, Outcome]]) -> None:
    out, outcome = runs["threads"]
    truth = film.ground_truth()
    for entry in outcome.stats["maps"]:
        assert entry["scale"]["source"] == "ground truth" and entry["voxels"]["high"] == pytest.approx(0.025)
        path = read_tum(out / entry["folder"] / "trajectory.tum")
        i, j = match_timestamps(path.timestamps_ns, truth.timestamps_ns)
        matched = (Trajectory(t.timestamps_ns[k], t.T_world_cam[k]) for t, k in ((path, i), (truth, j)))
        assert 1e-6 < summarize(absolute_errors(*matched, Alignment.SE3)).rmse < 0.01
    scales = [entry["scale"]["metres_per_map_unit"] for entry in outcome.stats["maps"]]
    assert scales[0] != scales[1]


def test_threads_change_nothing_in_any_map(runs: dict[str, tuple[Path, Outcome]]) -> None:
    (a, _), (b, _) = runs.values()
    files = {path.relative_to(a) for path in a.rglob("*") if path.is_file()}
    assert len(files) > 40 and files == {path.relative_to(b) for path in b.rglob("*") if path.is_file()}
    for file in files - {Path("stats.json"), Path("report.html")}:
        assert (a / file).read_bytes() == (b / file).read_bytes(), file


@pytest.mark.parametrize("threads", [True, False])
def test_live_the_larger_map_moves_into_its_place(film: CutFilm, tmp_path: Path, threads: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vitamin3d.runtime.LIVE_SNAPSHOTS_AHEAD", 1000)  # however busy the machine, none is dropped
    outcome = reconstruct(film, Job(live_config(Config()), threads=threads, live=True, metric_scale=2.0), tmp_path)
    first, second = outcome.stats["maps"]
    assert (first["birth"], second["birth"]) == (1, 0) and not list((tmp_path / "maps").glob(".*"))
    assert stamps(tmp_path / "maps/2").max() < stamps(tmp_path).min()
    for folder in (tmp_path, tmp_path / "maps/2"):
        assert set(views(folder)) <= set(stamps(folder).tolist()) and (folder / "mesh_high.ply").is_file()
    assert (first["scale"]["known"], second["scale"]["known"]) == (False, True)  # given for the map that came first


def test_a_fault_in_the_second_map_leaves_the_first_whole(film: CutFilm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = MapOutput.fuse

    def breaks(output: MapOutput, view: DepthView) -> None:
        if output.folder.path != tmp_path:
            raise RuntimeError("a fault was put in")
        whole(output, view)

    monkeypatch.setattr(MapOutput, "fuse", breaks)
    with pytest.raises(WorkerError, match="a fault was put in"):
        reconstruct(film, Job(QUICK, metric_scale=2.0), tmp_path)
    stats = json.loads((tmp_path / "stats.json").read_text())
    assert "a fault was put in" in stats["failure"] and (tmp_path / "report.html").is_file()
    assert {path.name for path in tmp_path.iterdir()} >= FILES
    lesser = tmp_path / "maps" / "2"
    assert len(stamps(lesser)) >= CUT - 2
    assert "2 metres per map unit" in (tmp_path / "trajectory.tum").read_text()
    assert "its scale is unknown" in (lesser / "trajectory.tum").read_text() and "up to scale" in (lesser / "trajectory.tum").read_text()


# --- the command -----------------------------------------------------------------------------------------------------


def pictures(folder: Path, upside_down: list[int], as_they_are: list[int], cut_first: bool) -> Path:
    folder.mkdir()
    paths = sorted((DEMO / "mav0" / "cam0" / "data").iterdir())
    turned = [cv2.flip(cv2.imread(str(paths[k])), -1) for k in upside_down]
    plain = [cv2.imread(str(paths[k])) for k in as_they_are]
    for index, picture in enumerate(turned + plain if cut_first else plain + turned):
        cv2.imwrite(str(folder / f"{index:05d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    (folder / "camera.yaml").write_text((DEMO / "mav0" / "cam0" / "sensor.yaml").read_text())
    return folder


def vitamin3d(source: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "vitamin3d.cli", "reconstruct", str(source), "-o", str(out), "--no-mesh", "--quiet", *options]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)


def test_a_false_start_is_left_behind(tmp_path: Path) -> None:
    source = pictures(tmp_path / "in", list(range(110, 140)), list(range(150)), cut_first=True)
    done = vitamin3d(source, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    found = stamps(tmp_path / "out")
    assert (found >= int(30 / 20 * 1e9)).sum() >= 140
    if len(found) < 0.9 * 180:
        assert done.stderr.startswith("warning: only ") and "--start 30" in done.stderr


def test_the_command_names_all_maps(tmp_path: Path) -> None:
    source = pictures(tmp_path / "in", list(range(GOES_ON, 150)), list(range(CUT)), cut_first=False)
    done = vitamin3d(source, tmp_path / "out")
    assert done.returncode == 0 and done.stderr == ""
    lines = done.stdout.splitlines()
    assert " in 2 maps (largest: " in lines[0]
    assert [line for line in lines if str(tmp_path / "out" / "maps" / "2") in line]
    refused = vitamin3d(source, tmp_path / "out")
    assert refused.returncode == 2 and "already holds a result" in refused.stderr
