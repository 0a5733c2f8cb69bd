# SPDX-License-Identifier: Apache-2.0
"""The paper's Fig. 3 and Fig. 4 of a sequence, on a page. Copy it and change what is drawn.

    python pipelines/paper_figures.py SEQUENCE output [OTHER_TRAJECTORY ...]

Fig. 3: tracked extrema, points, mesh, and normals at both voxel sizes, from one viewpoint. Fig. 4: the error in time, ours and that of
other systems' trajectories, where the sequence has a ground truth.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from vitamin3d import Config, Job, OutputFolder, SilentObserver, TruthRequest, Unreadable, evaluate, open_dataset, read_run, read_truth
from vitamin3d import reconstruct_sequence as reconstruct
from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.exporters.line_plot import Axes, Line, line_plot
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.normal_map import NormalCaster
from vitamin3d.exporters.rendering import draw, draw_points, jpeg, side_by_side, stepped_aside, viewer
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array

WIDTH, BACK, UP = 480, 0.3, 0.2
LABELS = ("(a) tracked extrema", "(b) points", "(c) mesh", "(d) normals, fine", "(d) normals, coarse")


def extrema(out: Path, dataset: Dataset, timestamp_ns: int, shape: tuple[int, int]) -> Array:
    """The picture nearest in time with its tracked extrema, (H, W, 3)."""
    index = int(np.argmin(np.abs(dataset.timestamps_ns - timestamp_ns)))
    frame, tracks = dataset.read(index), np.load(out / "tracks.npz")
    assert not isinstance(frame, Unreadable)
    drawn = cv2.cvtColor(frame.image, cv2.COLOR_GRAY2RGB)
    for u, v in tracks["pixel"][tracks["frame_index"] == index]:
        cv2.circle(drawn, (round(float(u)), round(float(v))), 1, (80, 255, 80), -1)
    return np.asarray(cv2.resize(drawn, shape))


def figure_3(out: Path, dataset: Dataset) -> Array:
    """Five panels from the keyframe in the middle, a little behind and above."""
    keyframes, canvas = read_tum(out / "keyframes.tum"), viewer(read_calibration(out / "depth" / "canvas.yaml").camera, WIDTH)
    fine, coarse = (NormalCaster(read_ply(out / f"mesh_{name}.ply")) for name in ("high", "low"))
    k = len(keyframes) // 2
    T_cam_world = inverse(keyframes.T_world_cam[k])
    depth = fine.median_depth(canvas, T_cam_world)
    T_view = stepped_aside(T_cam_world, depth, 0.0, UP * depth, BACK * depth)
    cloud = read_geometry(out / "cloud.ply")
    panels = [
        extrema(out, dataset, int(keyframes.timestamps_ns[k]), (canvas.width, canvas.height)),
        draw_points(cloud.points, cloud.colors, canvas, T_view),
        draw(fine, canvas, T_view, "color"),
        draw(fine, canvas, T_view, "normals"),
        draw(coarse, canvas, T_view, "normals"),
    ]
    return side_by_side(panels, LABELS)


def figure_4(runs: dict[str, Path], source: Path, dataset: Dataset) -> str:
    """The errors of trajectories after Sim(3) over time, SVG."""
    lines = []
    for name, path in runs.items():
        series = evaluate(read_run(path), read_truth(TruthRequest(source), dataset), dataset)["chronological"]
        lines.append(Line(name, np.array(series["seconds"]), 100 * np.array(series["error"])))
    return line_plot(Axes(dataset.name, "time [s]", "error [cm]", from_zero=True), lines)


def main(argv: list[str] | None = None) -> int:
    """Reconstructs `argv[0]` into `argv[1]`, unless that is done, and draws; further arguments are trajectories for Fig. 4."""
    source, out, *others = (Path(argument) for argument in (sys.argv[1:] if argv is None else argv))
    dataset = open_dataset(source)
    if not (out / "tracks.npz").exists():
        reconstruct(dataset, Job(Config(), save_tracks=True), OutputFolder(out, overwrite=True), SilentObserver())
    (out / "figure_3.jpg").write_bytes(jpeg(figure_3(out, dataset)))
    if dataset.ground_truth() is not None:
        (out / "figure_4.svg").write_text(figure_4({"ours": out, **{str(path): path for path in others}}, source, dataset))
    print(out / "figure_3.jpg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
