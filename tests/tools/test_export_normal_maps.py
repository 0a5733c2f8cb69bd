# SPDX-License-Identifier: Apache-2.0
import cv2
import pytest

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_normal_maps_of_every_second_keyframe(tool, run, frame):
    assert tool("export_normal_maps").main([str(run), "--every", "2", "--frame", frame, "--mesh", "low"]) == 0
    files = sorted((run / "normals_mesh_low").iterdir())
    assert [f.name for f in files] == ["1.000000001.png", "3.000000001.png"]
    blue, green, _ = cv2.imread(str(files[0]))[30, 40]
    assert (blue > 240) == (frame == "camera") and abs(int(green) - 128) <= 1
    assert (cv2.imread(str(files[0])) > 0).any(axis=2).mean() < (cv2.imread(str(files[1])) > 0).any(axis=2).mean() <= 1
