# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.exporters.mesh import read_cloud_ply, write_cloud_ply
from vitamin3d.types import PointCloud


@pytest.fixture
def cloud(tmp_path):
    rng = np.random.default_rng(0)
    quality = (np.linspace(0, 20, 200), np.linspace(2, 0, 200), np.geomspace(1e-3, 1, 200))
    columns = (rng.integers(2, 20, 200).astype(np.int32), *(values.astype(np.float32) for values in quality))
    written = PointCloud(rng.random((200, 3)), rng.integers(0, 255, (200, 3)).astype(np.uint8), *columns)
    write_cloud_ply(written, tmp_path / "cloud.ply", ["lengths in metres"])
    return written


def test_clouds_are_filtered_by_their_properties(tool, cloud, tmp_path, capsys):
    options = ["--min-parallax", "5", "--max-rms", "1", "--max-deviation", "0.5", "--min-observations", "6"]
    assert tool("filter_cloud").main([str(tmp_path / "cloud.ply"), str(tmp_path / "good.ply"), *options]) == 0
    good = (cloud.parallax_deg >= 5) & (cloud.reprojection_rms_px <= 1) & (cloud.depth_deviation <= 0.5) & (cloud.num_observations >= 6)
    read, comments = read_cloud_ply(tmp_path / "good.ply")
    assert f"{good.sum()} of 200 points" in capsys.readouterr().out and 20 < good.sum() < 150
    for name in ("points_world", "colors", "num_observations", "parallax_deg", "reprojection_rms_px", "depth_deviation"):
        np.testing.assert_allclose(getattr(read, name), getattr(cloud, name)[good], rtol=1e-6)
    assert comments[0] == "lengths in metres" and "parallax from 5 degrees" in comments[1]


def test_a_filter_that_leaves_nothing_and_foreign_clouds_are_refused(tool, cloud, run, tmp_path, capsys):
    filter_cloud = tool("filter_cloud")
    assert filter_cloud.main([str(tmp_path / "cloud.ply"), str(tmp_path / "good.ply"), "--min-parallax", "90"]) == 2
    assert "loosen" in capsys.readouterr().err
    assert filter_cloud.main([str(run / "mesh_high.ply"), str(tmp_path / "good.ply")]) == 2
    assert "not a cloud that vitamin3d wrote" in capsys.readouterr().err
    assert filter_cloud.main([str(tmp_path / "none.ply"), str(tmp_path / "good.ply")]) == 2
    assert not (tmp_path / "good.ply").exists()
