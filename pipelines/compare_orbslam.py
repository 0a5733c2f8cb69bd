# SPDX-License-Identifier: Apache-2.0
"""Our cloud and mesh beside ORB-SLAM's map of the same pictures, on a page. Copy it and change what is compared.

    python pipelines/compare_orbslam.py SEQUENCE output ORBSLAM_FOLDER

ORBSLAM_FOLDER holds its trajectory (`CameraTrajectory.txt`, `KeyFrameTrajectory.txt`, ...) and its map points (`MapPoints.txt`, PLY
or PCD); without a trajectory the clouds are put onto each other by their shape. The command `vitamin3d compare` has more options.
"""

import sys
from pathlib import Path

from vitamin3d import Config, Job, OutputFolder, SilentObserver, TruthRequest, compare, open_dataset, read_other, read_own, read_truth
from vitamin3d import reconstruct_sequence as reconstruct
from vitamin3d.evaluation.comparison_text import markdown, picture
from vitamin3d.evaluation.reference_surface import cloud_of_depth
from vitamin3d.exporters.rendering import jpeg


def main(argv: list[str] | None = None) -> int:
    """Reconstructs `argv[0]` into `argv[1]`, unless that is done, and compares with `argv[2]`."""
    source, out, other = (Path(argument) for argument in (sys.argv[1:] if argv is None else argv))
    dataset = open_dataset(source)
    if not (out / "stats.json").exists():
        reconstruct(dataset, Job(Config()), OutputFolder(out), SilentObserver())

    truth = read_truth(TruthRequest(source), dataset)  # None where the sequence brings none: then our run is the world
    path = dataset.ground_truth()
    surface = cloud_of_depth(source, dataset, path) if path is not None else None  # the true surface, from depth maps

    report, placed = compare(read_own(out), [read_other(str(other))], truth, surface)
    report |= {"unit": "metre" if truth is not None else "map unit", "ours": "ours: mesh"}
    (out / "comparison.md").write_text(markdown(report))
    (out / "comparison.jpg").write_bytes(jpeg(picture(placed, out, {"right": 0.0, "up": 0.2, "back": 0.4})))
    print(markdown(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
