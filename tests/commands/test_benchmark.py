# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d benchmark`: it goes on where it was, writes the paper's tables, and says mistakes in one line."""

import json
from pathlib import Path

import numpy as np
import pytest
from scenes import DEMO, SHORT_RUN, demo_copy


@pytest.mark.slow
def test_the_command_goes_on_and_writes_the_tables(finished_benchmark, command, tmp_path):
    job, results = finished_benchmark
    out, peer = Path(job.folder).parent, tmp_path / "peers" / "orbslam3" / "V1_01_easy"
    peer.mkdir(parents=True)
    ours = (out / "V1_01_easy" / "trial_0" / "trajectory.tum").read_text()
    last = ours.splitlines()[-1].split()
    later = "".join(f"{float(last[0]) + 0.1 * k:.9f} {50 * k} 0 {' '.join(last[3:])}\n" for k in range(1, 50))
    (peer / "CameraTrajectory.txt").write_text(ours + later)  # it saw more pictures, and erred there
    told = command("benchmark", "euroc", Path(job.source).parent, "-o", out, "--trials", "2", *SHORT_RUN, "--peers", tmp_path / "peers")
    assert told.code == 0, told.err
    assert "orbslam3 (measured)" in told.out and "140.0" not in told.out and "9.7 ± 0.2 cm" in told.out
    report = json.loads((out / "benchmark.json").read_text())["sequences"]["V1_01_easy"]
    assert report["ours"]["cm"][0] == pytest.approx(np.mean([100 * r["ate"]["Sim(3)"] for r in results]))
    assert report["peers"]["orbslam3"]["ate"] == pytest.approx(results[0]["ate"]["Sim(3)"], rel=1e-6)
    assert report["peers"]["orbslam3"]["success_rate"] == pytest.approx(results[0]["success_rate"])
    assert (out / "fig4_V1_01_easy.svg").read_text().count("<polyline") == 3


def test_mistakes_are_one_line(command, tmp_path):
    assert "nowhere" in command("benchmark", "euroc", tmp_path / "nowhere", "-o", tmp_path / "out").error
    assert "no kitti sequence" in command("benchmark", "kitti", DEMO, "-o", tmp_path / "out").error
    broken = demo_copy(tmp_path / "root" / "broken")
    (broken / "mav0" / "cam0" / "sensor.yaml").write_text("intrinsics: [1]\n")
    told = command("benchmark", "euroc", tmp_path / "root", "-o", tmp_path / "out", "--trials", "1")
    assert told.code == 2 and "vitamin3d: broken: " in told.err.splitlines()[-1] and "intrinsics" in told.err
