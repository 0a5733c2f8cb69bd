# SPDX-License-Identifier: Apache-2.0
import dataclasses

import cv2
import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.config import Config, DelaunayConfig, DensificationConfig, SurfaceConfig
from vitamin3d.dense.densification import CanvasPicture, Densifier
from vitamin3d.dense.view_graph import Neighbourhood
from vitamin3d.geometry.cameras import PinholeCamera
from vitamin3d.geometry.se3 import exp_se3, inverse
from vitamin3d.reconstruction import Reconstruction
from vitamin3d.types import Frame, MapSnapshot

CAMERA = PinholeCamera(220.0, 220.0, 127.5, 95.5, 256, 192)
NORMAL, OFFSET = np.array([0.1, 0.2, 1.0]), 3.0
INSIDE = np.zeros((CAMERA.height, CAMERA.width), bool)


def texture():
    rng = np.random.default_rng(3)
    fine, coarse = rng.uniform(0, 255, (600, 800)), rng.uniform(0, 255, (150, 200))
    mixed = 0.4 * cv2.GaussianBlur(fine, (0, 0), 1.2) * 3 - 150 + 0.6 * cv2.resize(coarse, (800, 600), interpolation=cv2.INTER_CUBIC)
    return np.clip(mixed, 1, 255).astype(np.float32)


TEXTURE = texture()


def picture_of_plane(T_world_cam, landmarks=60, seed=0):
    """The plane <NORMAL, X> = OFFSET with the texture painted along x and y, and a few exact landmarks on it."""
    grid = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), -1).reshape(-1, 2).astype(float)

    def depths(pixels):
        rays = CAMERA.rays_from_ideal(pixels) @ T_world_cam[:3, :3].T
        return rays, (OFFSET - NORMAL @ T_world_cam[:3, 3]) / (rays @ NORMAL)

    rays, z = depths(grid)
    points = rays * z[:, None] + T_world_cam[:3, 3]
    at = (points[:, :2] * 140.0 + [400, 300]).astype(np.float32).reshape(CAMERA.height, CAMERA.width, 2)
    image = cv2.remap(TEXTURE, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    pixels = np.random.default_rng(seed).uniform(5, [CAMERA.width - 5, CAMERA.height - 5], (landmarks, 2))
    frame = Frame(0, int(1e9 * T_world_cam[0, 3]), np.rint(image).astype(np.uint8))
    snapshot = MapSnapshot(frame, inverse(T_world_cam), pixels, depths(pixels)[1], np.full(landmarks, 0.01))
    return snapshot


def pictured(snapshot, image=lambda frame: frame.image, is_outside=INSIDE):
    return CanvasPicture(snapshot, image, is_outside)


def scene(count=7, step=0.09):
    poses = [exp_se3(np.array([step * k, -0.02 * k, 0.01 * k, 0.004 * k, -0.006 * k, 0.01 * k])) for k in range(count)]
    return [pictured(picture_of_plane(T, seed=k)) for k, T in enumerate(poses)]


def true_depths(snapshot):
    T_world_cam = inverse(snapshot.T_cam_world)
    rays = CAMERA.rays_from_ideal(snapshot.pixels) @ T_world_cam[:3, :3].T
    return (OFFSET - NORMAL @ T_world_cam[:3, 3]) / (rays @ NORMAL)


def densified(**settings):
    pictures = scene()
    around = Neighbourhood(pictures[3], pictures[2::-1], pictures[4:])
    return pictures[3].snapshot, Densifier(CAMERA, CAMERA, DensificationConfig(**settings)).densify(around)


def test_many_vertices_are_added_and_their_deviations_are_honest():
    before, after = densified()
    added = len(after.depths) - len(before.depths)
    assert added > 300
    np.testing.assert_array_equal(after.pixels[: len(before.pixels)], before.pixels)
    errors = (after.depths / true_depths(after) - 1)[len(before.depths) :]
    deviations = after.relative_deviations[len(before.depths) :]
    assert np.median(np.abs(errors)) < 0.004
    assert (np.abs(errors) < 5 * deviations).mean() > 0.97


def test_one_vertex_per_cell_at_most():
    before, after = densified(cell_px=16)
    cells = np.floor(after.pixels[len(before.pixels) :] / 16).astype(int)
    assert len(np.unique(cells, axis=0)) == len(cells) > 80


def test_without_parallax_or_landmarks_the_keyframe_stays_as_it_was():
    pictures = scene(3, step=0.0)
    still = [pictured(dataclasses.replace(p.snapshot, T_cam_world=np.eye(4))) for p in pictures]
    densifier = Densifier(CAMERA, CAMERA, DensificationConfig())
    assert densifier.densify(Neighbourhood(still[1], still[:1], still[2:])) is still[1].snapshot
    moving = scene(3)
    assert densifier.densify(Neighbourhood(moving[1], [], [])) is moving[1].snapshot
    few = pictured(picture_of_plane(np.eye(4), landmarks=5))
    assert densifier.densify(Neighbourhood(few, moving[:1], moving[2:])) is few.snapshot


def test_refinement_finds_the_best_patch():
    """The twin: ZNCC of the two best neighbours on a fine grid of depths, for a few pixels."""
    pictures = scene(3)
    densifier = Densifier(CAMERA, CAMERA, DensificationConfig())
    snapshot, pixels = pictures[1].snapshot, np.array([[60, 50], [128, 96], [190, 140]])
    start = 1.0 / true_depths(dataclasses.replace(snapshot, pixels=pixels.astype(float))) * 1.01
    motions, sources = [], []
    for other in (pictures[0], pictures[2]):
        T = other.snapshot.T_cam_world @ inverse(snapshot.T_cam_world)
        motions.append(T[:3, :3].T @ T[:3, 3])
        H = CAMERA.K @ T[:3, :3] @ np.linalg.inv(CAMERA.K)
        size, flags = (CAMERA.width, CAMERA.height), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        sources.append(cv2.warpPerspective(other.image, H, size, flags=flags).astype(np.float32))
    kept, refined, _ = densifier._refined(pictures[1], np.array(sources), np.array(motions), pixels, start)
    assert len(kept) == 3
    image = pictures[1].image.astype(np.float32)
    for (u, v), xi, found in zip(pixels, start, refined, strict=True):
        patch, scores, grid = image[v - 4 : v + 5, u - 4 : u + 5], [], np.linspace(0.95 * xi, 1.05 * xi, 201)
        for z in grid:
            total = 0.0
            for source, motion in zip(sources, motions, strict=True):
                x = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0]) + z * motion
                center = (CAMERA.fx * x[0] / x[2] + CAMERA.cx, CAMERA.fy * x[1] / x[2] + CAMERA.cy)
                total += reference.zncc(patch, cv2.getRectSubPix(source, (9, 9), center))
            scores.append(total)
        assert found == pytest.approx(grid[int(np.argmax(scores))], rel=4e-3)


def test_only_what_is_compared_is_drawn():
    drawn = []
    first, middle, last = (pictured(p.snapshot, lambda frame: drawn.append(frame) or frame.image) for p in scene(3))
    aside = pictured(middle.snapshot, lambda _: pytest.fail("a neighbour without parallax was drawn"))
    for _ in range(2):
        more = Densifier(CAMERA, CAMERA, DensificationConfig()).densify(Neighbourhood(middle, [aside, first], [last]))
        assert len(more.pixels) > len(middle.snapshot.pixels) and len(drawn) == 3


def test_the_border_of_the_canvas_is_no_picture():
    outside = INSIDE.copy()
    outside[:11, :] = True
    picture = pictured(picture_of_plane(np.eye(4)), lambda _: np.zeros(INSIDE.shape, np.uint8), outside)
    assert (picture.image[:11] == 0).all() and (picture.image[11:] == 1).all()
    assert (picture.reduced[:6] == 0).all() and (picture.reduced[6:] > 0).all()


def test_a_denser_keyframe_makes_a_better_surface():
    config = dataclasses.replace(Config(), delaunay=DelaunayConfig(min_vertices=20), surface=SurfaceConfig(min_component_triangles=20))
    covered = {}
    for enabled in (True, False):
        densification = dataclasses.replace(config.densification, enabled=enabled, keyframe_stride=2)
        reconstruction = Reconstruction(CAMERA, dataclasses.replace(config, densification=densification))
        views = list(reconstruction.depth_views(p.snapshot for p in scene()))
        assert len(views) == (4 if enabled else 7)
        covered[enabled] = np.mean([(view.depth > 0).mean() for view in views])
    assert covered[True] > 0.8 and covered[True] > covered[False]


def test_parallax_and_overlap_are_those_of_the_formulas():
    here, there = picture_of_plane(np.eye(4)), picture_of_plane(exp_se3(np.array([0.3, -0.1, 0.05, 0.02, -0.1, 0.03])))
    one, other = (pictured(s) for s in (here, there))
    densifier = Densifier(CAMERA, CAMERA, DensificationConfig())
    points = CAMERA.rays_from_ideal(here.pixels) * here.depths[:, None]
    T = there.T_cam_world @ inverse(here.T_cam_world)
    moved = points @ T[:3, :3].T + T[:3, 3]
    angles = [np.arccos(p @ q / np.linalg.norm(p) / np.linalg.norm(q)) for p, q in zip(points @ T[:3, :3].T, moved, strict=True)]
    parallax, overlap = densifier._parallax_and_overlap(points, one.snapshot, other)
    assert parallax == pytest.approx(np.degrees(np.median(angles))) and 0.3 < overlap < 1.0
    assert overlap == CAMERA.is_inside(CAMERA.ideal_from_points(moved)).mean()
