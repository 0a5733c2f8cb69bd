# SPDX-License-Identifier: Apache-2.0
"""Trajectories come back from a TUM file as they went in."""

from pathlib import Path

import numpy as np
import pytest

from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import OutputError
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.types import Trajectory


def some_trajectory(count: int) -> Trajectory:
    random = np.random.default_rng(3)
    times = 1_403_715_284_312_143_104 + np.cumsum(random.integers(1, 10**9, count))
    return Trajectory(times, np.array([exp_se3(random.normal(size=6)) for _ in range(count)]).reshape(-1, 4, 4))


@pytest.mark.parametrize("count", [0, 1, 25])
def test_round_trip(tmp_path: Path, count: int) -> None:
    written = some_trajectory(count)
    write_tum(written, tmp_path / "t.tum", ["made by a test", "two\nlines"])
    read = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(read.timestamps_ns, written.timestamps_ns)
    assert read.timestamps_ns.dtype == np.int64
    assert read.T_world_cam.shape == (count, 4, 4)
    np.testing.assert_allclose(read.T_world_cam, written.T_world_cam, atol=1e-8)


def test_the_text(tmp_path: Path) -> None:
    T = np.eye(4)
    T[:3, 3] = [1.5, -1e-12, 3.0]
    write_tum(Trajectory(np.array([1_000_000_001]), T[None]), tmp_path / "t.tum", ["hello"])
    line = "1.000000001 1.500000000 0.000000000 3.000000000 0.000000000 0.000000000 0.000000000 1.000000000"
    assert (tmp_path / "t.tum").read_bytes().decode() == f"# hello\n{line}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["t.tum"]


def test_an_old_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("old")
    write_tum(some_trajectory(2), tmp_path / "t.tum")
    assert len(read_tum(tmp_path / "t.tum")) == 2


def test_output_errors(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "missing" / "t.tum", tmp_path / "folder"):
        with pytest.raises(OutputError, match=path.name) as caught:
            write_tum(some_trajectory(2), path)
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_poses_must_be_finite(tmp_path: Path) -> None:
    bad = some_trajectory(2)
    bad.T_world_cam[1, 0, 3] = np.nan
    with pytest.raises(OutputError, match="not finite"):
        write_tum(bad, tmp_path / "t.tum")
    assert not list(tmp_path.iterdir())
