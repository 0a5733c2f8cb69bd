# SPDX-License-Identifier: Apache-2.0
"""Whatever is wrong with the input: one line that says so, the right exit code, and nothing half-written."""

import errno
import json
import os
import pathlib
import re
import shutil
import signal
import sys
import threading

import cv2
import numpy as np
import pytest
from scenes import DEMO

from vitamin3d.cli import main
from vitamin3d.commands.process import ONE_THREAD_EACH
from vitamin3d.progress import ConsoleObserver

PICTURES = sorted((DEMO / "mav0" / "cam0" / "data").glob("*.jpg"))
SENSOR = DEMO / "mav0" / "cam0" / "sensor.yaml"
CHATTER = re.compile(r"(first run: |tracking and mapping: |reconstructing: |stopping: |warning: )")

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


class Result:
    def __init__(self, code, out, err):
        self.code, self.out = code, out
        self.warnings = [line for line in err.splitlines() if line.startswith("warning: ")]
        self.errors = [line for line in err.splitlines() if not CHATTER.match(line)]


@pytest.fixture
def vitamin3d(monkeypatch, capsys):
    """Runs the console script in this process."""
    for name in (*ONE_THREAD_EACH, "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, os.environ.get(name, "1" if name != "OMP_WAIT_POLICY" else "passive"))

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["vitamin3d", *map(str, arguments)])
        handler = signal.getsignal(signal.SIGINT)
        with pytest.raises(SystemExit) as caught:
            main()
        assert signal.getsignal(signal.SIGINT) is handler
        assert not [t for t in threading.enumerate() if t.name.startswith("vitamin3d")]
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return Result(caught.value.code or 0, out, err)

    return run


@pytest.fixture
def out(tmp_path):
    """Where results go; at the end nothing temporary may be there."""
    folder = tmp_path / "out"
    yield folder
    assert [path for path in tmp_path.rglob("*") if path.name.endswith(".tmp")] == []


def calibration_text(**changes):
    """The demo's calibration with fields replaced."""
    text = SENSOR.read_text()
    for field, value in changes.items():
        text, count = re.subn(rf"(?m)^{field}:.*$", f"{field}: {value}", text)
        assert count == 1
    return text


def folder_of(path, count=12, **calibration):
    """A folder of the demo's first pictures with a camera.yaml."""
    path.mkdir()
    for picture in PICTURES[:count]:
        shutil.copy(picture, path)
    (path / "camera.yaml").write_text(calibration_text(**calibration))
    return path


def euroc_of(path, rows):
    """A EuRoC sequence with the given (time, picture) rows."""
    cam = path / "mav0" / "cam0"
    (cam / "data").mkdir(parents=True)
    for _, picture in rows:
        shutil.copy(picture, cam / "data")
    (cam / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{time},{picture.name}\n" for time, picture in rows))
    shutil.copy(SENSOR, cam)
    return path


def assert_refused(result, out, *words):
    """One line, exit code 2, no result."""
    assert result.code == 2
    assert len(result.errors) == 1 and result.errors[0].startswith("vitamin3d: "), result.errors
    for word in words:
        assert word in result.errors[0], result.errors[0]
    assert result.out == ""
    assert not out.exists() or not [path for path in out.rglob("*") if path.is_file()]


# --- sources -----------------------------------------------------------------------------------------------------


def test_a_missing_source(vitamin3d, tmp_path, out):
    assert_refused(vitamin3d("reconstruct", tmp_path / "nowhere", "-o", out), out, "nowhere: no such file or folder")


@pytest.mark.slow
def test_a_run_without_a_surface_says_so_and_writes_no_empty_mesh(vitamin3d, tmp_path, out):
    (tmp_path / "strict.toml").write_text("[surface]\nmin_component_triangles = 100000000\n")
    result = vitamin3d("reconstruct", DEMO, "-o", out, "--config", tmp_path / "strict.toml", "--max-frames", "45", "--quiet")
    said = [line for line in result.errors if not line.startswith("compiling kernels")]
    assert result.code == 1 and len(said) == 1
    assert "mesh_low.ply and mesh_high.ply would be empty" in said[0] and "min_component_triangles" in said[0]
    assert not list(out.glob("mesh_*")) and (out / "trajectory.tum").is_file() and (out / "cloud.ply").is_file()
    assert json.loads((out / "stats.json").read_text())["empty_meshes"] == ["mesh_low", "mesh_high"]


def test_an_empty_folder(vitamin3d, tmp_path, out):
    (tmp_path / "empty").mkdir()
    assert_refused(vitamin3d("reconstruct", tmp_path / "empty", "-o", out), out, "empty: no calibration")
    assert_refused(vitamin3d("reconstruct", tmp_path / "empty", "-o", out, "--calibration", SENSOR), out, "empty: no pictures")


def test_one_picture_only(vitamin3d, tmp_path, out):
    assert_refused(vitamin3d("reconstruct", folder_of(tmp_path / "one", 1), "-o", out), out, "only one picture")


def test_a_file_that_is_no_sequence(vitamin3d, tmp_path, out):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "broken.mp4").write_bytes(b"not a video at all")
    assert_refused(vitamin3d("reconstruct", tmp_path / "notes.txt", "-o", out), out, "not a video")
    assert_refused(vitamin3d("reconstruct", PICTURES[0], "-o", out), out, "a single picture")
    assert_refused(vitamin3d("reconstruct", tmp_path / "broken.mp4", "-o", out, "--calibration", SENSOR), out, "broken.mp4")


def test_a_missing_calibration(vitamin3d, tmp_path, out):
    source = folder_of(tmp_path / "pictures")
    (source / "camera.yaml").unlink()
    assert_refused(vitamin3d("reconstruct", source, "-o", out), out, "no calibration; give --calibration")
    assert_refused(vitamin3d("reconstruct", source, "-o", out, "--calibration", tmp_path / "none.yaml"), out, "none.yaml")


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("intrinsics", "[-292.8, 291.84, 234.384, 165.568]", "focal lengths must be positive"),
        ("intrinsics", "[292.8, 291.84, 234.384]", "`intrinsics` must be 4 numbers, found 3"),
        ("intrinsics", "[.nan, 291.84, 234.384, 165.568]", "finite"),
        ("resolution", "[640, 480]", "the pictures are 480×320, the calibration is for 640×480"),
        ("resolution", "[0, 320]", "positive integers"),
        ("distortion_model", "equidistant", "equidistant"),
    ],
)
def test_a_wrong_calibration(vitamin3d, tmp_path, out, field, value, words):
    source = folder_of(tmp_path / "pictures", **{field: value})
    assert_refused(vitamin3d("reconstruct", source, "-o", out), out, words)


def test_a_calibration_that_is_no_text(vitamin3d, tmp_path, out):
    source = folder_of(tmp_path / "pictures")
    (source / "camera.yaml").write_bytes(b"\xff\xfe\x00\x01")
    assert_refused(vitamin3d("reconstruct", source, "-o", out), out, "camera.yaml")


@pytest.mark.parametrize("times", [(3, 2, 4), (1, 1, 2), (5, -1, 7)], ids=["descending", "equal", "negative"])
def test_times_that_do_not_ascend(vitamin3d, tmp_path, out, times):
    source = euroc_of(tmp_path / "seq", list(zip(times, PICTURES[:3], strict=True)))
    assert_refused(vitamin3d("reconstruct", source, "-o", out), out, "data.csv")


def test_nothing_readable(vitamin3d, tmp_path, out):
    source = folder_of(tmp_path / "pictures", 5)
    for picture in source.glob("*.jpg"):
        picture.write_bytes(b"")
    assert_refused(vitamin3d("reconstruct", source, "-o", out), out, "none of its 5 pictures can be read")


# --- single bad pictures -----------------------------------------------------------------------------------------


def spoilt_run(vitamin3d, source, out):
    """A run over a folder that has too few frames for a map; its warnings and statistics."""
    result = vitamin3d("reconstruct", source, "-o", out)
    assert result.code == 3 and len(result.errors) == 1 and result.errors[0].startswith("no map: ")
    return result.warnings, json.loads((out / "stats.json").read_text())


def test_a_truncated_picture_is_skipped_and_counted(vitamin3d, tmp_path, out):
    source = folder_of(tmp_path / "pictures")
    bad = sorted(source.glob("*.jpg"))[5]
    bad.write_bytes(bad.read_bytes()[:4000])
    warnings, stats = spoilt_run(vitamin3d, source, out)
    assert len(warnings) == 1 and bad.name in warnings[0] and "cut off" in warnings[0] and "skipped" in warnings[0]
    assert (stats["frames"], stats["processed_frames"], stats["unreadable_frames"]) == (12, 11, 1)
    assert stats["skipped"] == [f"{bad.name}: the file is cut off"]


def test_pictures_of_another_size_are_skipped_and_counted(vitamin3d, tmp_path, out):
    source = folder_of(tmp_path / "pictures")
    for bad in sorted(source.glob("*.jpg"))[3:5]:
        cv2.imwrite(str(bad), cv2.resize(cv2.imread(str(bad)), (240, 160)))
    warnings, stats = spoilt_run(vitamin3d, source, out)
    assert len(warnings) == 2 and all("240×160" in line for line in warnings)
    assert (stats["processed_frames"], stats["unreadable_frames"]) == (10, 2)


def test_a_missing_picture_is_skipped_and_counted(vitamin3d, tmp_path, out):
    rows = [(10**9 + k, picture) for k, picture in enumerate(PICTURES[:6])]
    source = euroc_of(tmp_path / "seq", rows)
    (source / "mav0" / "cam0" / "data" / PICTURES[2].name).unlink()
    warnings, stats = spoilt_run(vitamin3d, source, out)
    assert len(warnings) == 1 and "missing" in warnings[0]
    assert (stats["frames"], stats["unreadable_frames"]) == (6, 1)


# --- options -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--voxel-high", "0.02"), "need --metric-scale or --scale-from-ground-truth"),
        (("--voxel-low", "0.2"), "need --metric-scale or --scale-from-ground-truth"),
        (("--voxel-low", "-1", "--metric-scale", "2"), "--voxel-low: must be positive"),
        (("--metric-scale", "0"), "--metric-scale: must be positive"),
        (("--metric-scale", "nan"), "--metric-scale: must be positive"),
        (("--metric-scale", "2", "--scale-from-ground-truth"), "exclude each other"),
        (("--scale-from-ground-truth",), "no ground truth"),
        (("--start", "99"), "only 0 of 12 frames are selected"),
        (("--stride", "50"), "only 1 of 12 frames are selected"),
    ],
)
def test_options_that_make_no_sense(vitamin3d, tmp_path, out, options, words):
    assert_refused(vitamin3d("reconstruct", folder_of(tmp_path / "pictures"), "-o", out, *options), out, words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[extrema]\nmax_trakcs = 3", "unknown setting extrema.max_trakcs"),
        ("[extrema", "not a readable TOML file"),
        (None, "settings.toml"),
    ],
)
def test_unknown_settings(vitamin3d, tmp_path, out, text, words):
    path = tmp_path / "settings.toml"
    if text is not None:
        path.write_text(text)
    assert_refused(vitamin3d("reconstruct", DEMO, "-o", out, "--config", path), out, words)


@pytest.mark.parametrize(
    "arguments",
    [
        ("reconstruct",),
        ("reconstruct", DEMO),
        ("reconstruct", DEMO, "-o", "x", "--no-such-option"),
        ("reconstruct", DEMO, "-o", "x", "--stride", "0"),
        ("reconstruct", DEMO, "-o", "x", "--start", "-1"),
        ("reconstruct", DEMO, "-o", "x", "--max-frames", "1"),
        ("reconstruct", DEMO, "-o", "x", "--max-frames", "many"),
        ("reconstruct", DEMO, "-o", "x", "--seed", "-1"),
        ("reconstruct", DEMO, "-o", "x", "--mode", "fast"),
        ("explode",),
    ],
)
def test_usage_errors_exit_with_2(vitamin3d, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    result = vitamin3d(*arguments)
    assert result.code == 2 and any("Error" in line for line in result.errors) and result.out == ""
    assert list(tmp_path.iterdir()) == []


def test_help_version_and_settings_exit_with_0(vitamin3d, tmp_path):
    from vitamin3d.config import load_toml, paper_config

    assert "reconstruct" in vitamin3d("--help").out and "--metric-scale" in vitamin3d("reconstruct", "--help").out
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", vitamin3d("version").out)
    shown = vitamin3d("config", "--mode", "paper")
    (tmp_path / "paper.toml").write_text(shown.out)
    assert shown.code == 0 and load_toml(tmp_path / "paper.toml") == paper_config()


# --- outputs -----------------------------------------------------------------------------------------------------


def test_a_file_in_the_place_of_the_output_folder(vitamin3d, tmp_path):
    place = tmp_path / "taken"
    place.write_text("mine")
    for out in (place, place / "below"):
        result = vitamin3d("reconstruct", DEMO, "-o", out)
        assert result.code == 2 and len(result.errors) == 1 and "not a folder that can be written" in result.errors[0]
    assert place.read_text() == "mine"


def test_an_earlier_result_is_kept_without_overwrite(vitamin3d, tmp_path, out):
    out.mkdir()
    (out / "cloud.ply").write_text("precious")
    (out / "notes.txt").write_text("mine")
    result = vitamin3d("reconstruct", DEMO, "-o", out)
    assert result.code == 2 and len(result.errors) == 1
    assert "already holds a result (cloud.ply)" in result.errors[0] and "--overwrite" in result.errors[0]
    assert {path.name: path.read_text() for path in out.iterdir()} == {"cloud.ply": "precious", "notes.txt": "mine"}
    assert vitamin3d("reconstruct", folder_of(tmp_path / "pictures"), "-o", out, "--overwrite").code == 3
    assert (out / "notes.txt").read_text() == "mine" and not (out / "cloud.ply").exists()


def test_a_wrong_input_does_not_touch_an_earlier_result(vitamin3d, tmp_path, out):
    out.mkdir()
    (out / "cloud.ply").write_text("precious")
    for arguments in ((tmp_path / "nowhere",), (DEMO, "--start", "9999"), (DEMO, "--voxel-low", "1")):
        assert vitamin3d("reconstruct", *arguments, "-o", out, "--overwrite").code == 2
    assert (out / "cloud.ply").read_text() == "precious"


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["trajectory.tum", "cloud.ply", "mesh_high.ply", "stats.json", "report.html", "canvas.yaml", "depth"])
def test_a_full_disk(vitamin3d, out, monkeypatch, victim):
    """The disk is full from the given file on."""
    opened, full = pathlib.Path.open, []

    class Full:
        def __init__(self, file):
            self.file = file

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.file.close()

        def write(self, data):
            self.file.write(data[: len(data) // 2])
            self.file.flush()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def open_(self, mode="r", *arguments, **options):
        file = opened(self, mode, *arguments, **options)
        if "w" not in mode or out not in self.parents:
            return file
        hit = f".{victim}." in self.name or (victim == "depth" and self.parent.name == "depth" and ".png." in self.name)
        if hit and (victim != "stats.json" or (out / "trajectory.tum").exists()):  # the first stats.json is the probe
            full.append(True)
        return Full(file) if full else file

    monkeypatch.setattr(pathlib.Path, "open", open_)
    result = vitamin3d("reconstruct", DEMO, "-o", out, "--max-frames", "45")
    assert full and result.code == 2
    assert len(result.errors) == 1 and "No space left on device" in result.errors[0] and str(out) in result.errors[0]
    assert not (out / victim).is_file()
    for path in out.rglob("*.png"):
        assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None


# --- no map, and interruptions -----------------------------------------------------------------------------------


def static_pictures(path):
    """The same picture twelve times, with noise."""
    rng, image = np.random.default_rng(0), cv2.imread(str(PICTURES[0]), cv2.IMREAD_GRAYSCALE)
    path.mkdir()
    for k in range(12):
        cv2.imwrite(str(path / f"{k}.png"), np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    (path / "camera.yaml").write_text(SENSOR.read_text())
    return path


@pytest.mark.parametrize("threads", ["--threads", "--sequential"])
def test_a_standing_camera_gives_no_map(vitamin3d, tmp_path, out, threads):
    result = vitamin3d("reconstruct", static_pictures(tmp_path / "static"), "-o", out, threads)
    assert result.code == 3 and result.out == ""
    assert len(result.errors) == 1 and result.errors[0].startswith("no map: no parallax: the picture moved by 0.")
    stats = json.loads((out / "stats.json").read_text())
    assert (stats["frames"], stats["keyframes"], stats["tracked_frames"], stats["interrupted"]) == (12, 0, 0, False)
    assert "no parallax" in stats["initialization_failure"]
    assert sorted(path.name for path in out.iterdir()) == ["config.toml", "report.html", "stats.json"]


def test_black_pictures_give_no_map(vitamin3d, tmp_path, out):
    source = static_pictures(tmp_path / "black")
    for picture in source.glob("*.png"):
        cv2.imwrite(str(picture), np.zeros((320, 480), np.uint8))
    result = vitamin3d("reconstruct", source, "-o", out, "--mode", "paper")
    assert result.code == 3 and "too few features: 0 tracks" in result.errors[0]


def check_saved(result, out):
    assert result.code == 130 and result.errors == []
    stats = json.loads((out / "stats.json").read_text())
    assert stats["interrupted"] and 40 <= stats["processed_frames"] < 150 == stats["frames"]
    for name in ("trajectory.tum", "keyframes.tum", "cloud.ply", "config.toml", "mesh_high.ply"):
        assert (out / name).stat().st_size > 100, name
    lines = [line for line in (out / "trajectory.tum").read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == stats["tracked_frames"] > 30


@pytest.mark.slow
def test_a_stop_saves_what_there_is(vitamin3d, out, monkeypatch):
    frames = []
    monkeypatch.setattr(ConsoleObserver, "frame_done", lambda self, done, total, slam: frames.append(done))
    monkeypatch.setattr(ConsoleObserver, "should_stop", lambda self: len(frames) >= 60)
    check_saved(vitamin3d("reconstruct", DEMO, "-o", out), out)
    assert len(frames) == 60


def send_interrupt_at(monkeypatch, *at):
    """Ctrl-C after these numbers of frames."""
    frame_done = ConsoleObserver.frame_done

    def interrupting(self, done, total, slam):
        frame_done(self, done, total, slam)
        if done in at:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(ConsoleObserver, "frame_done", interrupting)


@pytest.mark.slow
def test_ctrl_c_saves_what_there_is(vitamin3d, out, monkeypatch):
    send_interrupt_at(monkeypatch, 50)
    check_saved(vitamin3d("reconstruct", DEMO, "-o", out), out)


def test_ctrl_c_twice_ends_at_once_and_saves_nothing(vitamin3d, out, monkeypatch):
    monkeypatch.setattr(ConsoleObserver, "should_stop", lambda self: False)  # a step that takes long
    send_interrupt_at(monkeypatch, 10, 20)
    result = vitamin3d("reconstruct", DEMO, "-o", out)
    assert result.code == 130 and result.errors == ["vitamin3d: interrupted, nothing saved"]
    assert not (out / "trajectory.tum").exists() and not (out / "stats.json").exists()


def test_ctrl_c_before_there_is_a_map(vitamin3d, out, monkeypatch):
    send_interrupt_at(monkeypatch, 5)
    result = vitamin3d("reconstruct", DEMO, "-o", out)
    assert result.code == 130 and len(result.errors) == 1 and result.errors[0].startswith("no map: ")
    assert json.loads((out / "stats.json").read_text())["interrupted"]


def test_depth_fused_while_the_calibration_changes_is_refused(vitamin3d, out):
    result = vitamin3d("reconstruct", DEMO, "-o", out, "--live", "--refine-calibration", "on")
    assert result.code == 2 and len(result.errors) == 1
    assert "--refine-calibration on and --live exclude each other" in result.errors[0]
