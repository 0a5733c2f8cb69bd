# SPDX-License-Identifier: Apache-2.0
"""From a sequence to a mesh on one page of public API. Copy it and change a step.

    python pipelines/reconstruct.py data/demo output

The command `vitamin3d reconstruct` does the same with more options; see `vitamin3d/job.py`.
"""

import sys
from pathlib import Path

from vitamin3d import Config, FrontEnd, OutputFolder, Reconstruction, Scale, Slam, Unreadable, open_dataset, point_cloud


def main(argv: list[str] | None = None) -> int:
    """Reconstructs `argv[0]` (a folder or a video; optionally a calibration third) into the folder `argv[1]`."""
    source, out, *calibration = sys.argv[1:] if argv is None else argv
    dataset = open_dataset(Path(source), Path(calibration[0]) if calibration else None)
    config, scale, output = Config(), Scale(), OutputFolder(Path(out), overwrite=True)

    front_end = FrontEnd(config)  # curvature, its extrema, and the flow between two pictures
    slam = Slam(dataset.camera, config)  # tracks the extrema, localises the camera, maps the landmarks

    for index in range(len(dataset)):
        frame = dataset.read(index)
        if isinstance(frame, Unreadable):
            print(f"skipped {frame.path}: {frame.reason}", file=sys.stderr)
            continue
        slam.process_frame(front_end.process(frame))
    if slam.map.num_keyframes == 0:
        print(f"no map: {slam.initialization_reason}", file=sys.stderr)
        return 3
    slam.finish()  # adjusts the whole map once more

    reconstruction = Reconstruction(slam.camera, config, num_keyframes=slam.map.num_keyframes)  # meshes, denoises and fuses the keyframes
    for keyframe, index in enumerate(slam.map.frame_indices):
        frame = dataset.read(index)
        if not isinstance(frame, Unreadable):
            reconstruction.add_keyframe(slam.snapshot(keyframe, frame))

    output.write_config(config)
    output.write_trajectories(slam.trajectory(), slam.keyframe_trajectory(), scale)
    output.write_cloud(point_cloud(slam.map, slam.camera, config.cloud, config.snapshot), scale, "")
    empty = output.write_surfaces(*reconstruction.surfaces(), scale, reconstruction.voxel_lengths(), reconstruction.filter_remark)
    print(f"{len(slam.trajectory())} of {len(dataset)} frames localised, {slam.map.num_keyframes} keyframes: {output.path}")
    if empty:
        print(f"no surface: {', '.join(empty)}", file=sys.stderr)
    return 1 if "mesh_high" in empty else 0


if __name__ == "__main__":
    sys.exit(main())
