# SPDX-License-Identifier: Apache-2.0
"""Compiles every kernel that a run needs, or loads it from the cache, by reconstructing a few made-up pictures.

numba compiles a kernel when it is first called: a minute for all of them, once per machine; a second or two to load them
in each later process. A camera does not wait for either, so it is done before the first picture comes.
"""

import dataclasses
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from vitamin3d.config import Config, live_config, paper_config
from vitamin3d.exporters.depth_map import counts_from_depth
from vitamin3d.exporters.mesh import obj_text
from vitamin3d.exporters.normal_map import rgb_from_normals
from vitamin3d.geometry.cameras import Camera, PinholeCamera
from vitamin3d.mapping.landmark_statistics import point_cloud
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.slam import Slam
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Array, Frame

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
NUM_FRAMES, PIXELS_PER_FRAME = 70, 5.0
DARK_FRAME = 60
"""After it the camera must be found again."""
PERIOD_NS = 50_000_000
SMALL_WINDOW = 5
Tell = Callable[[int, int, str], None]
"""Hears how many parts are done, of how many, and what comes next."""


def relief_camera() -> Camera:
    """The camera of `relief_frames`, slightly distorted so that the kernels of distortion are called."""
    return PinholeCamera(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT, (-0.01, 0.0, 0.0, 0.0))


def relief_frames(count: int = NUM_FRAMES, seed: int = 0) -> Iterator[Frame]:
    """A camera that flies sideways, and back, over a textured wall with hills as deep as half its distance."""
    rng = np.random.default_rng(seed)
    span = int(count * PIXELS_PER_FRAME) + 2 * WIDTH
    noise = rng.normal(size=(HEIGHT + 40, span)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    for index in range(count):
        shift = PIXELS_PER_FRAME * (index if index < 0.7 * count else 1.4 * count - index)
        at_u = u + shift
        for _ in range(8):  # where the ray meets the wall, by fixed-point iteration
            at_u = u + shift * (1.0 + 0.5 * np.sin(at_u / 60.0) * np.cos(v / 50.0)) / 1.5
        image = cv2.remap(texture, np.float32(at_u + WIDTH / 2), np.float32(v + 20), cv2.INTER_LINEAR)  # type: ignore[call-overload]
        yield _frame(index, image if index != DARK_FRAME else np.zeros_like(image))


def _frame(index: int, image: Array) -> Frame:
    grey = image.astype(np.uint8)
    return Frame(index, index * PERIOD_NS, grey, np.repeat(grey[..., None], 3, axis=2))


def warm_up(configs: list[Config] | None = None, tell: Tell | None = None) -> None:
    """Runs the made-up pictures through every step of each configuration; all named ones where none is given."""
    configs = configs if configs is not None else [_everything(Config()), live_config(Config()), paper_config()]
    tell = tell or (lambda done, total, name: None)
    frames = list(relief_frames())
    total = 3 * len(configs)
    for number, config in enumerate(configs):
        tell(3 * number, total, f"tracking and mapping, {config.mode} settings")
        slam = _tracked(frames, config)
        tell(3 * number + 1, total, f"adjusting the whole map, {config.mode} settings")
        slam.finish()
        point_cloud(slam.map, slam.camera, config.cloud, config.snapshot)
        tell(3 * number + 2, total, f"meshing and fusing, {config.mode} settings")
        _reconstructed(slam, frames, config)
    tell(total, total, "done")


def _everything(config: Config) -> Config:
    """The settings with what they leave out switched on."""
    calibration = dataclasses.replace(config.calibration, refine="on", first_keyframes=8)
    recovery = dataclasses.replace(config.recovery, merge_distance=0.02)
    return dataclasses.replace(config, calibration=calibration, recovery=recovery)


def _tracked(frames: list[Frame], config: Config) -> Slam:
    """With a window of few keyframes, so that older ones anchor it."""
    config = dataclasses.replace(config, window=dataclasses.replace(config.window, keyframes=min(SMALL_WINDOW, config.window.keyframes)))
    slam, front_end = Slam(relief_camera(), config), FrontEnd(config)
    for frame in frames:
        slam.process_frame(front_end.process(frame))
    return slam


def _reconstructed(slam: Slam, frames: list[Frame], config: Config) -> None:
    for backend in {config.fusion.backend, "blocks"}:
        fusion = dataclasses.replace(config.fusion, backend=backend, keyframes_for_depth=1)
        reconstruction = Reconstruction(slam.camera, dataclasses.replace(config, fusion=fusion), keeps_views=True)
        for keyframe, index in enumerate(slam.map.frame_indices):
            for view in reconstruction.add_keyframe(slam.snapshot(keyframe, frames[index])):
                counts_from_depth(view.depth, 1000.0)
                rgb_from_normals(view.normals_cam)
        fine = reconstruction.surfaces()[1]
        b"".join(obj_text(fine, [], ""))
