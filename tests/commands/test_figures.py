# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d figures` on the made-up run of conftest.py."""

import cv2
import numpy as np
import pytest
import scenes

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")]
DEMO = scenes.DEMO


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
