# SPDX-License-Identifier: Apache-2.0
"""Each kind of source is recognised; what is none is refused in one line."""

from collections.abc import Callable
from pathlib import Path

import pytest
from sequences import calibration, draw, frame, message

from vitamin3d.datasets import open_dataset

SHARED = Path(__file__).parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no sequences in {SHARED}")


def missing(tmp_path: Path) -> Path:
    return tmp_path / "none"


def a_text(tmp_path: Path) -> Path:
    return calibration(tmp_path)


def a_picture(tmp_path: Path) -> Path:
    return draw(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("make", "expected"),
    [(missing, "no such file or folder"), (a_text, "not a video (.avi, .mkv, .mov, .mp4)"), (a_picture, "a single picture")],
)
def test_no_source(tmp_path: Path, make: Callable[[Path], Path], expected: str) -> None:
    text = message(make(tmp_path))
    assert expected in text and text.startswith(str(tmp_path))


@pytest.mark.shared
@needs_shared
@pytest.mark.parametrize(
    ("name", "count", "poses", "color"),
    [
        ("room1_v101_easy", 700, 700, False),
        ("euroc_v101_start", 40, 60, False),
        ("kitchen", 1000, 1000, True),
        ("desk", 900, 0, True),
        ("kitti00", 200, 200, False),
    ],
)
def test_shared(name: str, count: int, poses: int, color: bool) -> None:
    dataset = open_dataset(SHARED / name)
    assert (dataset.name, len(dataset)) == (name, count)
    last = frame(dataset, count - 1)
    assert (last.color is not None) == color
    assert last.image.shape == (dataset.camera.height, dataset.camera.width)
    trajectory = dataset.ground_truth()
    assert (0 if trajectory is None else len(trajectory)) == poses
