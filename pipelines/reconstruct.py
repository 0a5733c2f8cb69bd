# SPDX-License-Identifier: Apache-2.0
"""From a sequence to a mesh on one page of public API. Copy it and change a step.

    python pipelines/reconstruct.py data/demo output

The command `vitamin3d reconstruct` does the same with more options; see `vitamin3d/job.py`.
"""

import sys
from pathlib import Path

from vitamin3d import Atlas, Config, FrontEnd, OutputFolder, Reconstruction, Scale, Unreadable, open_dataset, point_cloud


def main(argv: list[str] | None = None) -> int:
    """Reconstructs `argv[0]` (a folder or a video; optionally a calibration third) into the folder `argv[1]`."""
    source, out, *calibration = sys.argv[1:] if argv is None else argv
    dataset = open_dataset(Path(source), Path(calibration[0]) if calibration else None)
    config, scale, output = Config(), Scale(), OutputFolder(Path(out), overwrite=True)

    front_end = FrontEnd(config)  # curvature, its extrema, and the flow between two pictures
    atlas = Atlas(dataset.camera, config)  # tracks the extrema, localises the camera, maps the landmarks; a new map where it is lost

    for index in range(len(dataset)):
        frame = dataset.read(index)
        if isinstance(frame, Unreadable):
            print(f"skipped {frame.path}: {frame.reason}", file=sys.stderr)
            continue
        atlas.process_frame(front_end.process(frame))
    atlas.finish()  # adjusts each whole map once more
    if not atlas.ranked():
        print(f"no map: {atlas.current.initializer.reason}", file=sys.stderr)
        return 3

    output.write_config(config)
    empty: list[str] = []
    for number, slam in enumerate(atlas.ranked(), 1):  # the largest map first
        reconstruction = Reconstruction(slam.camera, config, num_keyframes=slam.map.num_keyframes)  # meshes, denoises and fuses keyframes
        for keyframe, index in enumerate(slam.map.frame_indices):
            frame = dataset.read(index)
            if not isinstance(frame, Unreadable):
                reconstruction.add_keyframe(slam.snapshot(keyframe, frame))

        folder = output.map_folder(number)
        folder.write_trajectories(slam.trajectory(), slam.keyframe_trajectory(), scale)
        folder.write_cloud(point_cloud(slam.map, slam.camera, config.cloud, config.snapshot), scale, "")
        surfaces, volumes = reconstruction.surfaces(), reconstruction.volumes
        missing = folder.write_surfaces(*surfaces, scale, volumes.voxel_lengths(), volumes.filter_remark)
        empty += missing if number == 1 else []
        print(f"{len(slam.trajectory())} of {len(dataset)} frames localised, {slam.map.num_keyframes} keyframes: {folder.path}")
    if empty:
        print(f"no surface: {', '.join(empty)}", file=sys.stderr)
    return 1 if "mesh_high" in empty else 0


if __name__ == "__main__":
    sys.exit(main())
