# SPDX-License-Identifier: Apache-2.0
"""The paper's Fig. 3 and Fig. 4 of a sequence, on a page. Copy it and change what is drawn.

    python pipelines/paper_figures.py SEQUENCE output [OTHER_TRAJECTORY ...]

Fig. 3: tracked extrema, points, mesh, and normals at both voxel sizes, from one viewpoint. Fig. 4: the error in time, ours and that of
other systems' trajectories, where the sequence has a ground truth.
"""

import sys
from pathlib import Path

import numpy as np

from vitamin3d import Config, Job, OutputFolder, SilentObserver, TruthRequest, evaluate, open_dataset, read_run, read_truth
from vitamin3d import reconstruct_sequence as reconstruct
from vitamin3d.datasets.base import Dataset
from vitamin3d.evaluation.paper_figure import Viewpoint, paper_figure
from vitamin3d.exporters.line_plot import Axes, Line, line_plot
from vitamin3d.exporters.rendering import jpeg


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
    (out / "figure_3.jpg").write_bytes(jpeg(paper_figure(out, [], dataset, Viewpoint())))
    if dataset.ground_truth() is not None:
        (out / "figure_4.svg").write_text(figure_4({"ours": out, **{str(path): path for path in others}}, source, dataset))
    print(out / "figure_3.jpg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
