# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d evaluate` on a made-up run of the demo sequence: figures, frames, formats, and one line for every mistake."""

import json

import numpy as np
import pytest
import scenes

from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.geometry.se3 import exp_se3, inverse, quaternion_xyzw
from vitamin3d.types import Trajectory

DEMO = scenes.DEMO
FRAMES, STRIDE, SCALE = 60, 2, 0.5
T_BODY_CAM = np.array(
    [[0.0149, -0.9999, 0.0041, -0.0216], [0.9996, 0.0150, 0.0257, -0.0647], [-0.0258, 0.0038, 0.9997, 0.0098], [0, 0, 0, 1]]
)
STATES = DEMO / "mav0" / "state_groundtruth_estimate0" / "data.csv"


def placed(truth, rows, rng=None):
    """The true poses in another world and unit; noise of 1 cm per axis where there is a generator."""
    poses = exp_se3(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 0.5])) @ truth.T_world_cam[rows]
    poses[:, :3, 3] += 0.01 * rng.standard_normal((len(poses), 3)) if rng is not None else 0.0
    poses[:, :3, 3] *= SCALE
    return Trajectory(truth.timestamps_ns[rows], poses)


def write_tracks(path, demo, frames):
    """Points three metres before the first camera, tracked without error in every second frame."""
    truth, camera, rng = demo.ground_truth(), demo.camera, np.random.default_rng(3)
    points_cam = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), rng.uniform(2.5, 3.5, 50)])
    points = points_cam @ truth.T_world_cam[0, :3, :3].T + truth.T_world_cam[0, :3, 3]
    pixels = [camera.distort(scenes.project(camera, inverse(truth.T_world_cam[k]), points)) for k in frames]
    track_id = np.tile(np.arange(50), len(frames))
    np.savez(path, frame_index=np.repeat(frames, 50), track_id=track_id, pixel=np.concatenate(pixels).astype(np.float32))


@pytest.fixture
def out(demo, tmp_path):
    """A run of every second of the first sixty frames that lost the last one."""
    folder = tmp_path / "out"
    folder.mkdir()
    truth, frames = demo.ground_truth(), np.arange(0, FRAMES, STRIDE)
    assert (truth.timestamps_ns == demo.timestamps_ns).all()
    write_tum(placed(truth, frames[:-1], np.random.default_rng(5)), folder / "trajectory.tum")
    stats = {"frames": len(frames), "initialization_retries": 1, "scale": {"known": False, "source": ""}, "source": "demo"}
    (folder / "stats.json").write_text(json.dumps(stats))
    write_tracks(folder / "tracks.npz", demo, frames[:12])
    return folder


@pytest.fixture
def figures(command):
    """The JSON that the command prints."""

    def run(*arguments):
        told = command("evaluate", *arguments, "--json")
        assert told.code == 0, told.err
        return json.loads(told.out)

    return run


def rewritten(path, change):
    """The rows of a TUM file after `change(fields)`."""
    path.write_text("".join(" ".join(change(line.split())) + "\n" for line in path.read_text().splitlines() if line[0] != "#"))


def body_rig(demo, folder, count=60):
    """A rig like EuRoC's: a calibration with T_BS, a perfect camera trajectory, and its truth of the body."""
    camera = Trajectory(demo.timestamps_ns[:count], demo.ground_truth().T_world_cam[:count])
    R = T_BODY_CAM[:3, :3]
    U, _, Vt = np.linalg.svd(R)
    T = np.array(T_BODY_CAM)
    T[:3, :3] = U @ Vt
    write_tum(camera, folder / "camera.tum")
    write_tum(Trajectory(camera.timestamps_ns, camera.T_world_cam @ inverse(T)), folder / "body.tum")
    sensor = (DEMO / "mav0" / "cam0" / "sensor.yaml").read_text().splitlines()
    start = next(k for k, line in enumerate(sensor) if line.startswith("T_BS"))
    end = next(k for k in range(start + 1, len(sensor)) if sensor[k] and not sensor[k].startswith((" ", "\t")))
    numbers = ", ".join(f"{v:.12f}" for v in T.ravel())
    (folder / "sensor.yaml").write_text("\n".join([*sensor[:start], f"T_BS:\n  data: [{numbers}]", *sensor[end:]]))
    return folder


# --- figures ---------------------------------------------------------------------------------------------------------


def test_a_run_is_scored(out, figures):
    found = figures(out, "-g", DEMO)
    assert (found["frames"], found["localised"], found["retries"], found["is_metric"]) == (30, 29, 1, False)
    assert found["success_rate"] == pytest.approx(29 / 30)
    assert (found["truth"]["frame"], found["truth"]["matched"], found["matched_share"]) == ("body", 29, 1.0) or found["truth"][
        "frame"
    ] == "camera"
    assert found["scale"] == pytest.approx(1 / SCALE, rel=0.05)
    rmse = {name: errors["rmse"] for name, errors in found["ate"].items()}
    assert 0.01 < rmse["Sim(3)"] < 0.0174  # sqrt(3) cm, less what the alignment takes up
    assert rmse["SE(3)"] > rmse["Sim(3)"] and rmse["scale, first pose"] > rmse["Sim(3)"]
    axes = [errors["rmse"] for errors in found["axes"].values()]
    assert np.linalg.norm(axes) == pytest.approx(rmse["Sim(3)"], rel=1e-9)
    assert found["rpe"]["1 frame"]["translation"]["count"] == 28 and found["rpe"]["10 frames"]["translation"]["count"] == 19
    assert 0.01 < found["rpe"]["1 frame"]["translation"]["rmse"] < 0.04
    assert found["rpe"]["10 frames"]["rotation_deg"]["maximum"] < 1e-4
    assert found["rpe"]["1 s"]["translation"]["count"] == 19
    assert "0.1 m travelled" in found["rpe"] and "100 m travelled" not in found["rpe"]


def test_errors_in_time_add_up_to_the_ate(out, figures):
    found = figures(out, "-g", DEMO)
    series = {name: np.array(values) for name, values in found["chronological"].items()}
    assert series["seconds"][0] == 0 and series["seconds"][-1] == pytest.approx(2.8)
    assert series["running_rmse"][-1] == pytest.approx(found["ate"]["Sim(3)"]["rmse"], abs=1e-8)
    assert series["running_rmse"][0] == pytest.approx(series["error"][0])
    np.testing.assert_allclose(np.linalg.norm([series[axis] for axis in "xyz"], axis=0), series["error"], atol=1e-8)
    assert series["rotation_deg"].max() == pytest.approx(found["rotation_deg"]["maximum"], abs=1e-8)


def test_tracks_are_scored_by_the_truth(out, figures):
    tracks = figures(out, "-g", DEMO)["tracks"]
    assert (tracks["poses"], tracks["num_tracks"], tracks["live_median"], tracks["length_median"]) == ("ground truth", 50, 50, 12)
    ages = {a["age"]: (a["survival"], a["epipolar_inlier_ratio"]) for a in tracks["ages"]}
    assert ages[1] == ages[5] == ages[10] == (1.0, 1.0)
    assert ages[20] == ages[40] == (None, None)


def test_the_table_names_alignment_and_frame(out, command):
    told = command("evaluate", out, "-g", DEMO)
    assert told.code == 0
    for words in (
        "29 of 30 localised: success rate 96.7 %", "after 1 retries", "up to scale", "frame    camera: ", "after Sim(3)",
        "after SE(3)", "after scale, first pose", "poses: ground truth", "10 frames, rotation [deg]", "along y",
        "1 s, translation [cm]", "100.0 % of the run's",
    ):  # fmt: skip
        assert words in told.out, words


def test_files_are_written(out, command):
    assert command("evaluate", out, "-g", DEMO).code == 0
    names = {path.name for path in (out / "evaluation").iterdir()}
    assert names == {
        "evaluation.json",
        "evaluation.txt",
        "error_over_time.svg",
        "error_per_axis.svg",
        "rotation_over_time.svg",
        "trajectory.svg",
    }
    assert json.loads((out / "evaluation" / "evaluation.json").read_text())["frames"] == 30
    assert "after Sim(3)" in (out / "evaluation" / "evaluation.txt").read_text()
    for path in (out / "evaluation").glob("*.svg"):
        assert path.read_text().count("<polyline") in (1, 2, 3)
    before = {path.name for path in out.iterdir()}
    assert command("evaluate", out / "trajectory.tum", "-g", DEMO).code == 0
    assert {path.name for path in out.iterdir()} == before


def test_without_tracks_and_truth_the_rest_is_printed(out, command):
    (out / "tracks.npz").unlink()
    told = command("evaluate", out)
    assert told.code == 0 and "truth    none" in told.out and "29 of 30" in told.out


def test_a_bare_trajectory_is_counted_against_the_sequence(out, figures):
    found = figures(out / "trajectory.tum", "-g", DEMO)
    assert (found["frames"], found["localised"], found["retries"]) == (150, 29, None)
    assert figures(out / "trajectory.tum", "-g", STATES, "--truth-frame", "camera")["frames"] is None


@pytest.mark.filterwarnings("ignore")  # evo imports pandas, seaborn and others, each of which may warn
def test_figures_of_files_are_those_of_evo(out, demo, figures, tmp_path):
    """From the files on, with evo's own reading, matching, alignment and metrics."""
    pytest.importorskip("evo")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    write_tum(demo.ground_truth(), tmp_path / "truth.tum")
    found = figures(out, "-g", tmp_path / "truth.tum", "--source", DEMO)
    reference, estimate = (file_interface.read_tum_trajectory_file(str(p)) for p in (tmp_path / "truth.tum", out / "trajectory.tum"))
    reference, estimate = sync.associate_trajectories(reference, estimate, max_diff=0.02)
    estimate.align(reference, correct_scale=True)
    for relation, ours in (("translation_part", found["ate"]["Sim(3)"]), ("rotation_angle_deg", found["rotation_deg"])):
        ape = metrics.APE(metrics.PoseRelation[relation])
        ape.process_data((reference, estimate))
        theirs = ape.get_all_statistics()
        assert (ours["rmse"], ours["median"], ours["maximum"]) == pytest.approx((theirs["rmse"], theirs["median"], theirs["max"]), abs=1e-6)
    rpe = metrics.RPE(metrics.PoseRelation.translation_part, 10, metrics.Unit.frames, all_pairs=True)
    rpe.process_data((reference, estimate))
    assert found["rpe"]["10 frames"]["translation"]["rmse"] == pytest.approx(rpe.get_all_statistics()["rmse"], abs=1e-6)


# --- formats ---------------------------------------------------------------------------------------------------------


def test_formats_are_recognised(out, demo, figures, tmp_path):
    truth = demo.ground_truth()
    write_tum(truth, tmp_path / "truth.tum")
    rows = [
        f"{t}.000000 " + " ".join(line.split()[1:]) for t, line in zip(truth.timestamps_ns, lines_of(tmp_path / "truth.tum"), strict=True)
    ]
    (tmp_path / "nanoseconds.txt").write_text("\n".join(rows))
    (tmp_path / "poses.txt").write_text("\n".join(" ".join(f"{v:.9f}" for v in T[:3].ravel()) for T in truth.T_world_cam))
    (tmp_path / "times.txt").write_text("\n".join(f"{t // 10**9}.{t % 10**9:09d}" for t in truth.timestamps_ns))
    names = (tmp_path / "truth.tum", tmp_path / "nanoseconds.txt", tmp_path / "poses.txt", STATES)
    rmse = [figures(out, "-g", path, "--source", DEMO)["ate"]["Sim(3)"]["rmse"] for path in names]
    assert rmse == pytest.approx([rmse[0]] * 4, abs=1e-8) and rmse[0] > 0.01


def lines_of(path):
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def test_clocks_can_be_shifted(out, figures, command):
    late = read_tum(out / "trajectory.tum")
    write_tum(Trajectory(late.timestamps_ns + 10**12, late.T_world_cam), out / "trajectory.tum")
    assert "no overlap in time" in command("evaluate", out, "-g", DEMO).error
    assert "--time-offset -1000.000" in command("evaluate", out, "-g", DEMO).error
    assert figures(out, "-g", DEMO, "--time-offset", "-1000")["truth"]["matched"] == 29


# --- frames ----------------------------------------------------------------------------------------------------------


def test_a_truth_of_the_body_is_recognised_and_corrected(demo, tmp_path, figures):
    """The field's most common mistake, in a file that does not say what it is of."""
    rig = body_rig(demo, tmp_path)
    found = figures(rig / "camera.tum", "-g", rig / "body.tum", "--calibration", rig / "sensor.yaml")
    assert found["truth"]["frame"] == "body" and found["truth"]["frame_is_certain"] and "T_BS" in found["truth"]["frame_remark"]
    assert found["ate"]["Sim(3)"]["rmse"] < 1e-6 < 0.001 < found["truth"]["uncorrected_rmse"]
    assert found["truth"]["uncorrected_rotation_deg"] > 30
    told = figures(rig / "camera.tum", "-g", rig / "camera.tum", "--calibration", rig / "sensor.yaml")
    assert (told["truth"]["frame"], told["truth"]["uncorrected_rmse"]) == ("camera", None)


def test_who_says_that_the_truth_is_of_the_camera_is_believed_and_warned(demo, tmp_path, figures):
    rig = body_rig(demo, tmp_path)
    files = (rig / "camera.tum", "-g", rig / "body.tum", "--calibration", rig / "sensor.yaml")
    found, corrected = figures(*files, "--truth-frame", "camera"), figures(*files)
    assert found["truth"]["frame"] == "camera" and found["truth"]["frame_remark"].startswith("warning: ")
    assert found["ate"]["Sim(3)"]["rmse"] == pytest.approx(corrected["truth"]["uncorrected_rmse"], rel=1e-9)


def test_an_estimate_of_the_body_is_compared_with_the_body(demo, tmp_path, figures):
    rig = body_rig(demo, tmp_path)
    found = figures(rig / "body.tum", "-g", rig / "body.tum", "--calibration", rig / "sensor.yaml", "--truth-frame", "body")
    assert found["ate"]["Sim(3)"]["rmse"] < 1e-6 and "are of one frame" in found["truth"]["frame_remark"]


def test_a_rig_that_stands_still_is_told_by_where_it_is(demo, tmp_path, figures, command):
    """No similarity can be fitted to one place: both must be in one world."""
    rig = body_rig(demo, tmp_path)
    for name in ("camera.tum", "body.tum"):
        first = lines_of(rig / name)[0].split()[1:]
        rewritten(rig / name, lambda fields, first=first: [fields[0], *first])
    found = figures(rig / "camera.tum", "-g", rig / "body.tum", "--calibration", rig / "sensor.yaml")
    assert found["truth"]["frame"] == "body" and found["alignment"] == "no alignment" and found["scale"] is None
    assert found["ate"]["no alignment"]["rmse"] < 1e-6
    assert found["truth"]["uncorrected_rmse"] == pytest.approx(np.linalg.norm(T_BODY_CAM[:3, 3]), abs=1e-3)
    assert "hardly moved" in command("evaluate", rig / "camera.tum", "-g", rig / "body.tum", "--calibration", rig / "sensor.yaml").out


def test_without_extrinsics_a_truth_of_the_body_is_refused_or_warned_of(demo, tmp_path, command):
    rig = body_rig(demo, tmp_path)
    assert "T_BS" in command("evaluate", rig / "camera.tum", "-g", rig / "body.tum", "--truth-frame", "body").error
    told = command("evaluate", rig / "camera.tum", "-g", rig / "body.tum")
    assert told.code == 0 and "warning: the truth turns about other axes" in told.out


# --- mistakes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["trajectory.tum", "stats.json"])
def test_an_unfinished_run_is_one_line(out, name, command):
    (out / name).unlink()
    assert name in command("evaluate", out, "-g", DEMO).error


@pytest.mark.parametrize(("name", "text"), [("stats.json", "{"), ("stats.json", "[]"), ("stats.json", "{}"), ("tracks.npz", "no")])
def test_damaged_files_are_one_line(out, name, text, command):
    (out / name).write_text(text)
    assert name in command("evaluate", out, "-g", DEMO).error
    assert not (out / "evaluation").exists()


def test_missing_sources_and_truths_are_one_line(out, command, tmp_path):
    assert "nowhere" in command("evaluate", tmp_path / "nowhere", "-g", DEMO).error
    assert "nowhere" in command("evaluate", out, "-g", tmp_path / "nowhere.tum").error
    assert "nowhere" in command("evaluate", out, "--source", tmp_path / "nowhere").error


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: [f[0], *f[1:4], f[7], *f[4:7]], "order w x y z"),
        (lambda f: [*f[:4], *(f"{3 * float(v):.6f}" for v in f[4:])], "not of length 1"),
        (lambda f: [f[0], "nan", *f[2:]], "must be finite"),
        (lambda f: [f[0], "0", "0", "0", *f[4:]], "all positions are the same"),
        (lambda f: [f[0], *(f"{float(v) * 1e300:g}" for v in f[1:4]), *f[4:]], "cannot be reckoned with"),
        (lambda f: f[1:], "7 numbers per line"),
        (lambda f: ["hello", "world"], "not a trajectory"),
        (lambda f: [f"{float(f[0]) + 0.025:.9f}", *f[1:]], "match within 20 ms"),
    ],
)
def test_bad_trajectories_are_one_line(out, demo, change, words, command, tmp_path):
    sparse = demo.ground_truth()
    write_tum(Trajectory(sparse.timestamps_ns[::2], sparse.T_world_cam[::2]), tmp_path / "truth.tum")
    rewritten(out / "trajectory.tum", change)
    error = command("evaluate", out, "-g", tmp_path / "truth.tum").error
    assert words in error and "trajectory.tum" in error
    assert not (out / "evaluation").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: [*f[:4], f[7], *f[4:7]], "order w x y z"),
        (lambda f: [f[0], "1", "2", "3", *f[4:]], "all positions are the same"),
    ],
)
def test_bad_truths_are_one_line_that_names_them(out, demo, change, words, command, tmp_path):
    write_tum(demo.ground_truth(), tmp_path / "truth.tum")
    rewritten(tmp_path / "truth.tum", change)
    error = command("evaluate", out, "-g", tmp_path / "truth.tum").error
    assert words in error and "truth.tum" in error and "trajectory.tum" not in error


@pytest.mark.parametrize("offset", ["nan", "inf", "1e12", "-5e9"])
def test_offsets_that_no_clock_has_are_one_line(out, offset, command):
    assert "--time-offset" in command("evaluate", out, "-g", DEMO, "--time-offset", offset).error


def test_an_empty_trajectory_is_one_line(out, command):
    (out / "trajectory.tum").write_text("# nothing\n")
    assert "no poses" in command("evaluate", out, "-g", DEMO).error


def test_a_format_that_is_not_the_one_named_is_named(out, demo, command, tmp_path):
    write_tum(demo.ground_truth(), tmp_path / "truth.tum")
    error = command("evaluate", out, "-g", tmp_path / "truth.tum", "--format", "euroc").error
    assert "this is TUM" in error and "not EuRoC" in error
    error = command("evaluate", out, "-g", STATES, "--format", "kitti").error
    assert "this is EuRoC" in error and "not KITTI" in error
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    assert "times.txt" in command("evaluate", out, "-g", tmp_path / "poses.txt").error


def test_quaternions_of_the_demo_are_read_in_their_order(demo):
    """The table of the body has w first; a mistake here would move every figure above."""
    row = STATES.read_text().splitlines()[1].split(",")
    x, y, z, w = quaternion_xyzw(demo.ground_truth().T_world_cam[0][:3, :3])
    found = np.array([float(v) for v in row[4:8]])
    np.testing.assert_allclose(found * np.sign(found[0]), np.array([w, x, y, z]) * np.sign(w), atol=1e-6)


# --- its surface, on the run of conftest.py ---------------------------------------------------------------------------


@pytest.mark.slow
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


@pytest.mark.slow
def test_the_scene_is_pruned_to_what_keyframes_saw(run, command, tmp_path):
    """Against the whole scene the cloud is incomplete, against what keyframes saw it is not."""
    told = command("evaluate", run, "-g", DEMO, "--reference", DEMO / "scene.ply", "--json")
    assert told.code == 0, told.err
    found = json.loads(told.out)["surface"]
    assert found["observed"]["points"] < 0.9 * found["reference"]["points"]
    assert found["cloud"]["observed_by_keyframes"]["completeness_10cm"] > found["cloud"]["all"]["completeness_10cm"] + 0.05
