# SPDX-License-Identifier: Apache-2.0
"""tools/proving_ground.py: names, recipes, settings, rendering, rows and tables; the renderer and the product are stand-ins."""

import csv
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scenes

from vitamin3d.config import Config, load_toml
from vitamin3d.errors import InputError

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared"
needs_shared = pytest.mark.skipif(not (SHARED / "score").is_dir(), reason="the shared folder is not here")

RECIPE = """about = "A \\"plain\\" office, 60° at a time"
scene = { kind = "office", seed = 101, repetitive = true }
motion = { kind = "pan", rate_deg = 32.0, where = [0.24, 0.29] }
camera = "euroc"
frames = 700
seed = 1
plugin = "attic.py"
[picture]
light = 0.008
[hazards]
dropped = [[6.0, 8]]
covered = [[11.0, 20, "black"]]
moving = [{ at = 3.0, kind = "person", seed = 1 }]
"""
MAKE_SEQUENCE = """import sys
from pathlib import Path
recipe, out = Path(sys.argv[1]), Path(sys.argv[3])
(out / "mav0").mkdir(parents=True)
if "fails" in recipe.stem:
    sys.exit("Traceback\\nthe camera is in a wall")
(out / "recipe.toml").write_text(recipe.read_text())
(out / "arguments").write_text(" ".join(sys.argv[4:]))
if "stops" not in recipe.stem:
    (out / "frames.csv").write_text("# ns\\n")
"""
PRODUCT = """import shutil, sys
from pathlib import Path
source, out = Path(sys.argv[2]), Path(sys.argv[4])
if (source / "answer").is_dir():
    shutil.copytree(source / "answer", out)
    (out / "arguments").write_text(" ".join(sys.argv[5:]))
if "--config" in sys.argv:
    print(Path(sys.argv[sys.argv.index("--config") + 1]).read_text(), file=(out / "settings").open("w"))
code = source / "code"
if code.exists():
    sys.exit(print("vitamin3d: no map: darkness", file=sys.stderr) or int(code.read_text()))
"""
SCORE = """import json
def maps(sequence, out):
    found = out / "score.json"
    return json.loads(found.read_text()) if found.exists() else {"maps": 0, "success_rate": 0.0, "path_m": 4.0}
"""


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("proving_ground", ROOT / "tools" / "proving_ground.py")
    module = sys.modules["proving_ground"] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["proving_ground"]


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def shared(tmp_path, tool, monkeypatch):
    """A shared folder with four recipes, three sequences and stand-ins."""
    folder = tmp_path / "shared"
    for name in ("office_pan", "office_fails", "office_stops", "fisheye_room"):
        write(folder / "proving" / "recipes" / f"{name}.toml", RECIPE)
    write(folder / "proving" / "make_sequence.py", MAKE_SEQUENCE)
    write(folder / "score" / "score.py", SCORE)
    write(folder / "data" / "walk_loop" / "video.mp4", "")
    write(folder / "data" / "photos_lund" / "images" / "a.jpg", "")
    answer = folder / "data" / "kitchen" / "answer"
    scored = {"maps": 2, "success_rate": 0.875, "ate_percent_of_path": 0.5, "path_m": 4.0, "wrong_frames": 3}
    write(answer / "score.json", json.dumps(scored))
    milliseconds = {"tracked": 12.25, "not_localised": None}
    write(answer / "stats.json", json.dumps({"cpu_seconds": 9.5, "peak_memory_mb": 300.2, "frame_milliseconds": milliseconds}))
    (folder / "cases" / "stray_picture_inside").mkdir(parents=True)
    monkeypatch.setattr(tool, "PRODUCT", (sys.executable, str(write(tmp_path / "product.py", PRODUCT))))
    return folder


@pytest.fixture
def place(tool, shared, tmp_path):
    return tool.ProvingGround(shared, tmp_path / "ground", tmp_path / "work", tool.loaded_score(shared), case_seeds=3, timeout_s=60.0)


def target(tool, shared, name, frames=None):
    (found,) = tool.selected([name], tool.catalogue(shared), frames)
    return found


# --- names -----------------------------------------------------------------------------------------------------------


def test_names_mean_targets_in_their_order_each_once(tool, shared):
    names = tool.catalogue(shared)
    found = tool.selected(["walk_loop", "office_pan@7", "stray_picture_inside", "earlier", "walk_loop", "fisheye_room"], names)
    strays = ["stray_picture_inside/at5", "stray_picture_inside/at10"]
    assert [t.name for t in found] == ["walk_loop", "office_pan@7", *strays, "kitchen", "fisheye_room"]
    assert (found[1].group, found[1].base, found[1].seed) == ("recipes", "office_pan", 7) and found[2].kind == "at5"
    everything = [t.name for t in tool.selected([], names)]
    assert everything == ["office_fails", "office_pan", "office_stops", "walk_loop", "kitchen", "photos_lund", *strays]
    assert "fisheye_room" not in [t.name for t in tool.selected(["recipes"], names)]
    assert target(tool, shared, "stray_picture_inside/hand").kind == "hand"


def test_shortened_recipes_have_names_of_their_own(tool, shared):
    assert target(tool, shared, "office_pan", 50).name == "office_pan_50"
    assert target(tool, shared, "office_pan@3", 50).name == "office_pan@3_50"
    assert target(tool, shared, "walk_loop", 50).name == "walk_loop"


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("office", "no such"), ("office_pan@x", "no such"), ("", "no such"),
        ("walk_loop@3", "seeds"), ("kitchen/at5", "kinds"), ("stray_picture_inside/at6", "kinds"),
    ],
)  # fmt: skip
def test_unknown_names_are_one_line(tool, shared, capsys, name, word):
    assert tool.main([name, "--shared", str(shared)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"proving_ground: {name}: ") and word in line


def test_mistakes_are_one_line(tool, shared, tmp_path, capsys):
    at = ["--shared", str(shared)]
    broken = write(tmp_path / "broken.json", '{"tables": {"default": {"rows": []}}}')
    for arguments, word in (
        (["--shared", str(tmp_path / "nowhere")], "nowhere"),
        ([*at, "--ground", str(ROOT / "proving")], "inside the repository"),
        ([*at, "--workers", "0"], "at least 1"),
        ([*at, "--frames", "1"], "at least 2"),
        ([*at, "--json", str(tmp_path / "nowhere" / "x.json")], "its folder does not exist"),
        ([*at, "--against", str(broken)], "not a readable file"),
        ([*at, "--set", "window.anchors"], "section.key=value"),
        ([*at, "--set", "window.ankers=3"], "unknown setting window.ankers"),
        ([*at, "--ablate", "a:window.anchors=0", "--ablate", "a"], "a name of its own"),
        ([*at, "--ablate", "../a"], "a name of its own"),
    ):
        assert tool.main(arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("proving_ground: ") and word in line


# --- recipes and settings --------------------------------------------------------------------------------------------


def toml(tool, text):
    return tool.tomllib.loads(text)


def test_a_seeded_recipe_is_the_same_but_for_its_seeds(tool, tmp_path):
    before, after = toml(tool, RECIPE), toml(tool, tool.seeded_recipe(RECIPE, 7, tmp_path))
    assert after["seed"] == 7 and after["scene"]["seed"] == 108
    assert after["plugin"] == str(tmp_path / "attic.py")
    before["seed"], before["scene"]["seed"], before["plugin"] = after["seed"], after["scene"]["seed"], after["plugin"]
    assert after == before
    bare = toml(tool, tool.seeded_recipe('scene = { kind = "room" }\n', 4, tmp_path))
    assert bare == {"seed": 4, "scene": {"kind": "room", "seed": 4}}


@pytest.mark.shared
@needs_shared
def test_all_recipes_can_be_seeded(tool, tmp_path):
    for path in (SHARED / "proving" / "recipes").glob("*.toml"):
        before, after = toml(tool, path.read_text()), toml(tool, tool.seeded_recipe(path.read_text(), 5, path.parent))
        assert after["scene"].pop("seed") == before["scene"].pop("seed") + 5 and after.pop("seed") == 5
        assert after == {key: value for key, value in before.items() if key != "seed"}


def test_settings_become_toml(tool, tmp_path):
    changes = "window.anchors=0,calibration.refine=off,extrema.max_tracks=500"
    default, other = tool.variants(["extrema.max_tracks=2000"], ["default", f"no anchors:{changes}"])
    assert default.toml() == "extrema.max_tracks = 2000\n"
    config = load_toml(write(tmp_path / "a.toml", other.toml()))
    assert (config.window.anchors, config.calibration.refine, config.extrema.max_tracks) == (0, "off", 500)
    assert config.curvature == Config().curvature
    assert tool.title(other) == 'no anchors (extrema.max_tracks = 500, window.anchors = 0, calibration.refine = "off")'
    assert tool.variants([], []) == [tool.Variant()] and tool.title(tool.Variant()) == "default"
    assert tool.setting(" recovery.enabled = false") == ("recovery.enabled", "false") and tool.setting("a.b=1e-3") == ("a.b", "1e-3")
    with pytest.raises(InputError, match=r"^x: extrema.max_tracks must be like"):
        tool.variants([], ["x:extrema.max_tracks=many"])


# --- rendering -------------------------------------------------------------------------------------------------------


def test_a_sequence_is_rendered_once(tool, shared, tmp_path):
    ground, seeded = tmp_path / "ground", target(tool, shared, "office_pan@7", 50)
    folder = tool.render(seeded, shared, ground, 1)
    assert folder == ground / "office_pan@7_50" and (folder / "arguments").read_text() == "--frames 50"
    assert toml(tool, (folder / "recipe.toml").read_text())["scene"]["seed"] == 108
    made = (folder / "frames.csv").stat().st_mtime_ns
    assert tool.render(seeded, shared, ground, 1) == folder and (folder / "frames.csv").stat().st_mtime_ns == made
    assert sorted(path.name for path in ground.iterdir()) == ["office_pan@7_50", "recipes"]


@pytest.mark.parametrize(("name", "word"), [("office_fails", "the camera is in a wall"), ("office_stops", "ended with 0")])
def test_what_is_half_rendered_is_not_used(tool, shared, place, name, word):
    row = place.measure(tool.Variant(), target(tool, shared, name))
    assert row["exit_code"] is None and row["problem"] == f"not rendered: {word}"
    assert list(place.ground.iterdir()) == []


def listed(tool, shared, ground):
    return [line.split() for line in tool.listing(tool.catalogue(shared), ground).splitlines()]


def test_a_half_rendered_folder_is_replaced_and_no_other(tool, shared, tmp_path):
    ground, pan = tmp_path / "ground", target(tool, shared, "office_pan")
    write(ground / "office_pan" / "mav0" / "half.jpg", "")
    assert not tool.is_rendered(ground / "office_pan")
    assert ["recipes", "office_pan", "not", "rendered"] in listed(tool, shared, ground)
    folder = tool.render(pan, shared, ground, 1)
    assert tool.is_rendered(folder) and not (folder / "mav0" / "half.jpg").exists()
    for name in ("office_pan@2_9", "office_pan_by_night"):  # the second would be another recipe
        write(ground / name / "frames.csv", "")
    assert ["recipes", "office_pan", "rendered:", "office_pan,", "office_pan@2_9"] in listed(tool, shared, ground)
    write(ground / "office_pan_20" / "letters.txt", "mine")
    with pytest.raises(tool.NotMeasured, match="in the way"):
        tool.render(target(tool, shared, "office_pan", 20), shared, ground, 1)
    assert (ground / "office_pan_20" / "letters.txt").read_text() == "mine"


# --- rows ------------------------------------------------------------------------------------------------------------


def test_a_row_is_what_the_run_and_the_score_say(tool, shared, place):
    kitchen = target(tool, shared, "kitchen")
    row = place.measure(tool.variants(["window.anchors=0"], [])[0], kitchen)
    assert 0 <= row.pop("seconds") < 60
    assert row == {
        "maps": 2, "success_rate": 0.875, "ate_percent_of_path": 0.5, "path_m": 4.0, "wrong_frames": 3, "ate_cm": 2.0, "exit_code": 0,
        "tracked_ms": 12.25, "not_localised_ms": None, "cpu_seconds": 9.5, "peak_memory_mb": 300.2,
    }  # fmt: skip
    out = place.work / "default" / "kitchen"
    assert (out / "settings").read_text().strip() == "window.anchors = 0"
    assert "--sequential --no-mesh --quiet --overwrite --config" in (out / "arguments").read_text()
    expected = "kitchen: frames % 87.5, maps 2, ATE % 0.500, ATE cm 2.00, wrong 3, ms 12.2, CPU s 9.5, MB 300, exit 0"
    assert tool.progress("kitchen", row) == expected


@pytest.mark.parametrize("code", [2, 3])
def test_a_run_that_fails_gives_a_row(tool, shared, place, code):
    kitchen = shared / "data" / "kitchen"
    place.measure(tool.Variant(), target(tool, shared, "kitchen"))
    (kitchen / "answer").rename(kitchen / "no_answer")
    write(kitchen / "code", str(code))
    row = place.measure(tool.Variant(), target(tool, shared, "kitchen"))
    assert row["exit_code"] == code and row["success_rate"] == 0.0 and row["maps"] == 0  # not what the first run left
    assert row["problem"] == "no map: darkness" and "ate_cm" not in row
    assert tool.table({"kitchen": row}).splitlines()[-1] == "kitchen: no map: darkness"


@pytest.mark.slow
def test_the_product_refuses_and_gives_a_row(tool, shared, place, monkeypatch):
    monkeypatch.setattr(tool, "PRODUCT", (sys.executable, "-m", "vitamin3d.cli"))
    row = place.measure(tool.Variant(), target(tool, shared, "kitchen"))
    assert row["exit_code"] == 2 and "kitchen" in row["problem"] and row["maps"] == 0


def test_a_run_that_hangs_is_stopped(tool):
    row = tool.executed([sys.executable, "-c", "import time; time.sleep(60)"], 0.2)
    assert row == {"exit_code": None, "seconds": 0.2, "problem": "stopped after 0 s"}


def test_what_cannot_be_scored_is_said(tool, shared, place):
    write(shared / "data" / "kitchen" / "answer" / "score.json", "{")
    row = place.measure(tool.Variant(), target(tool, shared, "kitchen"))
    assert row["problem"].startswith("not scored: ") and row["exit_code"] == 0 and row["cpu_seconds"] == 9.5


def test_sources_and_calibrations(tool, shared, place):
    data = shared / "data"
    film = place.prepared(target(tool, shared, "walk_loop"))
    assert film == tool.Source(data / "walk_loop" / "video.mp4", data / "walk_loop" / "camera.yaml", data / "walk_loop")
    photos = place.prepared(target(tool, shared, "photos_lund"))
    assert photos == tool.Source(data / "photos_lund" / "images", data / "photos_lund" / "camera.yaml", data / "photos_lund")
    assert place.prepared(target(tool, shared, "kitchen")) == tool.Source(data / "kitchen", None, data / "kitchen")


def test_runs_of_several_seeds_are_one_row(tool):
    runs = [
        {"seed": k, "success_rate": s, "maps": 1 + k, "wrong_frames": w, "tracked_ms": ms, "cpu_seconds": 4.0 + k, "exit_code": code}
        for k, s, w, ms, code in ((0, 1.0, 0, 12.0, 0), (1, 0.5, 3, None, 3), (2, 0.9, 1, 14.0, 0))
    ]
    row = tool.combined(runs)
    assert (row["success_rate"], row["maps"], row["wrong_frames"], row["tracked_ms"], row["exit_code"]) == (0.5, 3, 4, 13.0, 3)
    assert row["cpu_seconds"] == 5.0 and row["not_localised_ms"] is None and row["runs"] == runs and "problem" not in row
    unscored = tool.combined([*runs, {"seed": 3, "exit_code": 0, "problem": "not scored: no numbers"}])
    assert unscored["wrong_frames"] is None and unscored["problem"] == "seed 3: not scored: no numbers"
    assert json.loads(json.dumps(row)) == row and tool.combined(runs[:1]) == runs[0]


# --- with the real scores --------------------------------------------------------------------------------------------


@pytest.fixture
def real(tool, tmp_path):
    return tool.ProvingGround(SHARED, tmp_path / "ground", tmp_path / "work", tool.loaded_score(SHARED))


def write_tum(path, seconds, centres, quaternions=None):
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (len(centres), 1)) if quaternions is None else quaternions
    write(path, "".join(" ".join(f"{x:.9f}" for x in row) + "\n" for row in np.column_stack([seconds, centres, turned])))


@pytest.mark.shared
@needs_shared
def test_two_maps_of_a_sequence_are_scored_each_on_its_own(tool, real, tmp_path):
    seconds = np.arange(200) / 20
    centres = np.column_stack([seconds, np.sin(seconds), 0.3 * np.cos(2 * seconds)])
    sequence, out = tmp_path / "sequence", tmp_path / "out"
    write_tum(sequence / "groundtruth.tum", seconds, centres)
    for k in range(200):
        write(sequence / "rgb" / f"{k:03d}.jpg", "")
    shown = "".join(f"{int(round(s * 1e9))},{0.01 if k >= 190 else 0.5}\n" for k, s in enumerate(seconds))
    write(sequence / "frames.csv", "# ns,textured\n" + shown)
    first, second = slice(0, 100), slice(110, 190)
    turned = centres[second] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    write_tum(out / "trajectory.tum", seconds[first], 3.0 * centres[first] + [1, 2, 3])
    write_tum(out / "maps" / "2" / "trajectory.tum", seconds[second], 0.1 * turned)
    office, source = tool.Target("office_plain", tool.FILMS, "office_plain"), tool.Source(sequence, None, sequence)
    row = real._scored(office, source, out)
    assert row["maps"] == 2 and row["sizes"] == [100, 80] and row["success_rate"] == pytest.approx(0.9)
    assert row["success_visible"] == pytest.approx(180 / 190)
    assert row["wrong_frames"] == 0 and row["scale_spread"] == pytest.approx(1.0) and row["ate_cm"] < 1e-3
    displaced = 3.0 * centres[first]
    displaced[50] += 1.5  # half a metre
    write_tum(out / "trajectory.tum", seconds[first], displaced)
    row = real._scored(office, source, out)
    assert row["wrong_frames"] == 1 and row["scale_spread"] > 2.0
    assert row["ate_cm"] == pytest.approx(100 * np.sqrt(3 * 0.5**2 / 180), rel=0.05)
    assert row["ate_cm"] == row["ate_percent_of_path"] * row["path_m"]
    walk = real._scored(tool.Target("walk_loop", tool.FILMS, "walk_loop"), source, out)
    assert "ate_cm" not in walk  # whose truth has no metre


def demo_poses():
    """Seconds, centres and quaternions x y z w of the body, at the demo's 150 pictures."""
    demo = scenes.DEMO / "mav0"
    rows = [row for row in csv.reader((demo / "state_groundtruth_estimate0" / "data.csv").open()) if not row[0].startswith("#")]
    times, values = np.array([int(row[0]) for row in rows]), np.array([[float(x) for x in row[1:8]] for row in rows])
    at = [np.argmin(np.abs(times - int(path.stem))) for path in sorted((demo / "cam0" / "data").iterdir())]
    return values[at, :3], values[at][:, [4, 5, 6, 3]]


@pytest.mark.slow
@pytest.mark.shared
@needs_shared
def test_stray_pictures_are_checked_in_all_maps(real, tmp_path):
    centres, quaternions = demo_poses()
    frames = [k for k in range(101) if k != 5]
    right = centres[[k - (k > 5) for k in frames]], quaternions[[k - (k > 5) for k in frames]]
    write_tum(tmp_path / "trajectory.tum", np.array(frames[:60]) / 20, right[0][:60], right[1][:60])
    wrong = right[0][60:].copy()
    wrong[7] += 0.2
    write_tum(tmp_path / "maps" / "2" / "trajectory.tum", np.array(frames[60:]) / 20, wrong, right[1][60:])
    row = real._strays("at5", tmp_path)
    assert row["maps"] == 2 and row["success_rate"] == 1.0 and row["wrong_frames"] == 1 and row["wrong"][0][0] == frames[67]
    with_stray = np.insert(right[0][:59], 5, 0.0, 0), np.insert(right[1][:59], 5, [0, 0, 0, 1], 0)
    write_tum(tmp_path / "trajectory.tum", np.arange(60) / 20, *with_stray)
    row = real._strays("at5", tmp_path)
    assert row["wrong_frames"] == 2 and row["success_rate"] == 0.99


@pytest.mark.shared
@needs_shared
def test_a_false_start_is_scored_after_the_cut(tool, real, tmp_path):
    case, out = tmp_path / "case", tmp_path / "out"
    for k in range(180):
        write(case / "cut" / f"{k:05d}.jpg", "")
    tool.add_demo_truth(case)
    centres = real.score.ground_truth(case)
    at = [np.argmin(np.abs(centres[0] - (30 + k) / 20)) for k in range(150)]
    write_tum(out / "trajectory.tum", (30 + np.arange(2, 150)) / 20, centres[1][at[2:]])
    write_tum(out / "maps" / "2" / "trajectory.tum", np.arange(30) / 20, np.zeros((30, 3)))
    row = real._scored(tool.Target(tool.FALSE_START, tool.CASES, tool.FALSE_START), tool.Source(case / "cut", None, case), out)
    assert row["success_rate"] == pytest.approx(148 / 150) and row["frames"] == 180 and row["maps"] == 2
    assert row["wrong_frames"] == 0 and row["ate_percent_of_path"] < 1e-3


@pytest.mark.shared
@needs_shared
def test_photographs_are_counted(tool, real, tmp_path):
    lund = real.prepared(target(tool, SHARED, "photos_lund"))
    assert real._photos(lund, tmp_path) == {"maps": 0, "placed": 0, "pictures": 12, "success_rate": 0.0}
    lines = (line.split() for line in (lund.truth / "reference.txt").read_text().splitlines() if line[0] != "#")
    reference = {Path(line[0]).stem: line[1:] for line in lines}
    names = sorted(path.stem for path in lund.pictures.iterdir())[:8]
    write_tum(tmp_path / "trajectory.tum", np.arange(8) / 30, np.array([reference[name] for name in names], float))
    row = real._photos(lund, tmp_path)
    assert (row["placed"], row["pictures"], row["maps"]) == (8, 12, 1) and row["ate_percent_of_path"] < 1e-4
    assert tool.COLUMNS[0].cell(row) == "8/12"


# --- tables ----------------------------------------------------------------------------------------------------------


def test_changes_are_shown_beside_figures(tool):
    pan = {"success_rate": 0.9923, "maps": 1, "ate_percent_of_path": 0.08121, "scale_spread": 1.0432, "tracked_ms": 12.31, "exit_code": 0}
    new = {
        "office_pan": pan,
        "photos_lund": {"success_rate": 11 / 12, "placed": 11, "pictures": 12, "exit_code": 0},
        "walk_loop": {"exit_code": None, "problem": "stopped after 60 s"},
    }
    worse = {"success_rate": 0.9613, "maps": 3, "ate_percent_of_path": 15.8, "scale_spread": 3317.0, "tracked_ms": 12.3, "exit_code": 3}
    old = {
        "office_pan": worse,
        "photos_lund": {"success_rate": 1.0, "placed": 12, "pictures": 12, "exit_code": 0},
        "walk_loop": {"success_rate": 0.86, "exit_code": 0, "scale_spread": 3317.2},
    }
    lines = tool.table(new, old).splitlines()
    assert len(lines) == 5 and [line.split()[0] for line in lines[1:4]] == list(new) and lines[4] == "walk_loop: stopped after 60 s"
    head, pan, photos, walk = ([cell.strip() for cell in line.split("  ") if cell.strip()] for line in lines[:4])
    assert head == [column.head for column in tool.COLUMNS]
    assert pan == [
        "office_pan", "99.2 (+3.1)", "-", "1 (-2)", "0.0812 (-15.7188)", "-", "1.043 (-3315.957)", "-", "12.3 (=)", "-", "-", "-", "0 (-3)"
    ]  # fmt: skip
    assert photos[1] == "11/12 (-8.3)" and walk[1] == "- (was 86.0)" and walk[6] == "- (was 3317)" and walk[-1] == "- (was 0)"
    assert len({len(line) for line in lines[:4]}) == 1  # columns are flush
    assert "(" not in tool.table(new).replace("stopped", "")


def test_figures_of_any_size_keep_their_digits(tool):
    ate = next(column for column in tool.COLUMNS if column.key == "ate_percent_of_path")
    shown = [ate.cell({ate.key: value}) for value in (0.0, 0.00012345, 0.081234, 1.2345, 15.81, 3317.2)]
    assert shown == ["0", "0.000123", "0.0812", "1.23", "15.8", "3317"]


def test_the_command_writes_runs_and_compares(tool, shared, tmp_path, capsys):
    at = ["--shared", str(shared), "--ground", str(tmp_path / "ground"), "--workers", "2"]
    assert tool.main([*at, "kitchen", "office_pan", "--json", str(tmp_path / "old.json")]) == 0
    said = capsys.readouterr().out.splitlines()
    assert sorted(line.split(":")[0] for line in said[:2]) == ["kitchen", "office_pan"]
    assert said[3] == "default" and [line.split()[0] for line in said[5:7]] == ["kitchen", "office_pan"]
    found = json.loads((tmp_path / "old.json").read_text())["tables"]["default"]
    assert list(found["rows"]) == ["kitchen", "office_pan"] and found["rows"]["kitchen"]["success_rate"] == 0.875
    assert not list(tmp_path.glob(".*")) and (tmp_path / "ground" / "office_pan" / "frames.csv").is_file()
    better = {"maps": 1, "success_rate": 1.0, "ate_percent_of_path": 0.25, "path_m": 4.0, "wrong_frames": 0}
    write(shared / "data" / "kitchen" / "answer" / "score.json", json.dumps(better))
    ablations = ["--ablate", "default", "--ablate", "without anchors:window.anchors=0"]
    more = ["--against", str(tmp_path / "old.json"), "--results", str(tmp_path / "results"), "--mesh", "--json", str(tmp_path / "new.json")]
    assert tool.main([*at, "kitchen", *ablations, *more]) == 0
    out = capsys.readouterr().out
    assert out.count("100.0 (+12.5)") == 2 and "without anchors (window.anchors = 0)\n" in out
    assert "without anchors: kitchen: frames % 100.0" in out
    tables = json.loads((tmp_path / "new.json").read_text())["tables"]
    assert list(tables) == ["default", "without anchors"] and tables["without anchors"]["settings"] == {"window.anchors": "0"}
    kept = tmp_path / "results" / "without_anchors" / "kitchen"
    assert "--no-mesh" not in (kept / "arguments").read_text() and (kept / "settings").read_text().strip() == "window.anchors = 0"


def test_rendering_alone(tool, shared, tmp_path, capsys):
    at = ["--shared", str(shared), "--ground", str(tmp_path / "ground"), "--render-only"]
    assert tool.main([*at, "office_pan", "kitchen"]) == 0
    assert capsys.readouterr().out == "office_pan: rendered in 0 s\n"
    assert tool.main([*at, "office_pan", "office_fails"]) == 1
    assert set(capsys.readouterr().out.splitlines()) == {
        "office_pan: already rendered",
        "office_fails: not rendered: the camera is in a wall",
    }
