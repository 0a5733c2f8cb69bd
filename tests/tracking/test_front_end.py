# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scenes import texture, warped

from vitamin3d.config import Config, paper_config
from vitamin3d.image.curvature import curvature
from vitamin3d.image.extrema import detect_extrema
from vitamin3d.tracking.front_end import FrontEnd, dense_flow_solver
from vitamin3d.types import Frame

SHIFT = np.array([4.0, -3.0])


def with_extrema(**settings):
    return replace(Config(), extrema=replace(Config().extrema, **settings))


def frames():
    image = texture(240, 320, np.random.default_rng(3), 6.0)
    return Frame(0, 0, image), Frame(1, 50, warped(image, np.eye(2), SHIFT))


def test_dense_flow_is_that_of_the_picture_and_starts_with_the_second():
    front_end = FrontEnd(Config())
    first, second = (front_end.process(frame) for frame in frames())
    assert first.dense_flow is None and first.dominant_flow.inlier_ratio == 0.0
    np.testing.assert_array_equal(first.dominant_flow.A, np.eye(2))
    reduction = Config().extrema_tracking.flow_reduction
    middle = reduction * second.dense_flow[20:-20, 20:-20]
    np.testing.assert_allclose(np.median(middle, axis=(0, 1)), SHIFT, atol=0.1)
    assert (np.abs(middle - SHIFT).max(axis=2) < 0.5).mean() > 0.9


def test_large_patches_of_a_blurred_picture_follow_noise_less():
    """The step of a noisy picture, median error in pixels: small patches against those of the default."""
    rng, errors = np.random.default_rng(5), []
    noisy = [
        replace(frame, image=np.clip(0.15 * frame.image + rng.normal(90, 8, frame.image.shape), 0, 255).astype(np.uint8))
        for frame in frames()
    ]
    small = {"flow_patch": 8, "flow_stride": 4, "flow_blur_px": 0.0, "flow_octave": 1, "flow_refinements": 0}
    for settings in (small, {}):
        front_end = FrontEnd(replace(Config(), extrema_tracking=replace(Config().extrema_tracking, **settings)))
        flow = [front_end.process(frame) for frame in noisy][1].dense_flow
        errors.append(np.median(np.hypot(*np.moveaxis(Config().extrema_tracking.flow_reduction * flow[20:-20, 20:-20] - SHIFT, -1, 0))))
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 1.5


@pytest.mark.parametrize(
    ("shape", "patch", "stride"),
    [
        ((240, 376), 12, 6), ((376, 240), 12, 6), ((120, 188), 6, 3), ((180, 282), 9, 5),
        ((60, 94), 4, 2), ((8, 8), 4, 1), ((540, 960), 16, 14), ((1080, 1920), 16, 16),
    ],
)  # fmt: skip
def test_the_patches_of_the_flow_go_with_the_picture_up_to_what_opencv_can_do(shape, patch, stride):
    quick, patient = dense_flow_solver(Config(), shape), dense_flow_solver(Config(), shape, patient=True)
    assert (quick.getPatchSize(), quick.getPatchStride()) == (patch, stride)
    assert patient.getPatchSize() == patch and patient.getPatchStride() == min(stride, patch // 2)  # they overlap by half
    assert patient.getGradientDescentIterations() > quick.getGradientDescentIterations()
    assert quick.getFinestScale() == 1 and patient.getFinestScale() == 0  # half of the reduced picture, and all of it
    assert quick.getVariationalRefinementIterations() == Config().extrema_tracking.flow_refinements > 0


def test_settings_of_the_flow_are_taken_in_proportion():
    config = replace(Config(), extrema_tracking=replace(Config().extrema_tracking, flow_patch=10, flow_stride=5, flow_octave=3))
    for shape, patch, stride in (((240, 376), 10, 5), ((480, 752), 16, 10), ((72, 113), 4, 2)):
        quick = dense_flow_solver(config, shape)
        assert (quick.getPatchSize(), quick.getPatchStride(), quick.getFinestScale()) == (patch, stride, 2)


FLOWS_OUT_OF_THE_PICTURE = """
import hashlib, cv2, numpy as np
from vitamin3d.config import Config
from vitamin3d.tracking.front_end import dense_flow_solver
cv2.setNumThreads(1)
rng, shape = np.random.default_rng(6), (540, 960)
picture = cv2.GaussianBlur(rng.integers(0, 256, shape, np.uint8), (0, 0), 3)
moved, start = np.roll(picture, (-60, -60), (0, 1)), np.full((*shape, 2), -60, np.float32)
for a, b in ((picture, moved), tuple(rng.integers(0, 256, (2, *shape), np.uint8))):
    flows = dense_flow_solver(Config(), shape).calc(a, b, None), dense_flow_solver(Config(), shape, patient=True).calc(a, b, start.copy())
    print([hashlib.md5(flow).hexdigest() for flow in flows])
"""


@pytest.mark.slow
def test_the_flow_of_large_pictures_does_not_depend_on_what_memory_held_before():
    """With patches above 16 pixels OpenCV reads beyond its pictures; glibc fills what it hands out with a byte."""
    told = set()
    for byte in ("1", "90", "200"):
        environment = os.environ | {"MALLOC_PERTURB_": byte}
        done = subprocess.run([sys.executable, "-c", FLOWS_OUT_OF_THE_PICTURE], env=environment, capture_output=True, text=True, check=True)
        told.add(done.stdout)
    assert len(told) == 1 and len(told.pop().splitlines()) == 2


@pytest.mark.slow
@pytest.mark.parametrize("patient", [False, True])
def test_the_flow_of_large_pictures_does_not_depend_on_the_pictures_before(patient):
    rng = np.random.default_rng(6)
    picture, noise = texture(540, 960, rng, 6.0), rng.integers(0, 256, (540, 960), np.uint8)
    moved, solver, flows = warped(picture, np.eye(2), SHIFT), dense_flow_solver(Config(), picture.shape, patient), []
    for _ in range(3):
        start = np.full((540, 960, 2), 3.0, np.float32) if patient else None  # a patient one always begins somewhere
        flows += [found.calc(picture, moved, start) for found in (solver, dense_flow_solver(Config(), picture.shape, patient))]
        solver.calc(noise, moved, rng.normal(0, 20, (540, 960, 2)).astype(np.float32) if patient else None)
    assert all(flow.tobytes() == flows[0].tobytes() for flow in flows)
    assert (np.abs(flows[0][20:-20, 20:-20] - SHIFT).max(axis=2) < 0.5).mean() > 0.95


@pytest.mark.slow
def test_a_front_end_finds_the_same_flow_as_another_in_full_hd():
    picture = texture(1080, 1920, np.random.default_rng(7), 9.0)
    pictures = [picture, warped(picture, np.eye(2), 2 * SHIFT), texture(1080, 1920, np.random.default_rng(8), 9.0), picture]
    flows = []
    for _ in range(2):
        front_end = FrontEnd(Config())
        flows.append([front_end.process(Frame(k, k, p)).dense_flow for k, p in enumerate(pictures)])
    assert [flow is None for flow in flows[0]] == [True, False, True, False]
    assert all(a is b is None or a.tobytes() == b.tobytes() for a, b in zip(*flows, strict=True))
    np.testing.assert_allclose(np.median(flows[0][1], axis=(0, 1)), SHIFT, atol=0.1)


def test_the_paper_uses_dominant_flow_instead():
    front_end = FrontEnd(paper_config())
    first, second = (front_end.process(frame) for frame in frames())
    assert first.dense_flow is None and second.dense_flow is None
    center = np.array([160.0, 120.0])
    np.testing.assert_allclose(second.dominant_flow.A @ center + second.dominant_flow.b, center + SHIFT, atol=2.0)
    assert second.dominant_flow.inlier_ratio > 0.5


@pytest.mark.parametrize("config", [paper_config(), with_extrema(wanted=0)], ids=["paper", "fixed"])
def test_curvature_and_extrema_are_those_of_the_frame(config):
    frame = frames()[1]
    front = FrontEnd(config).process(frame)
    assert front.frame is frame
    np.testing.assert_array_equal(front.kappa, curvature(frame.image, config.curvature))
    np.testing.assert_array_equal(front.extrema, detect_extrema(front.kappa, config.extrema))
    assert len(front.extrema) > 20


@pytest.mark.parametrize("wanted", [40, 60, 100])
def test_curvature_is_scaled_so_that_the_floor_sinks_to_the_extremum_wanted(wanted):
    config, frame = with_extrema(wanted=wanted, min_curvature=1e3), frames()[1]
    front = FrontEnd(config).process(frame)
    raw = curvature(frame.image, config.curvature)
    every = detect_extrema(raw, replace(config.extrema, min_curvature=0.02))
    np.testing.assert_array_equal(front.extrema, every[:wanted])
    floor = raw[every[wanted - 1, 1], every[wanted - 1, 0]]
    assert 0.02 < floor < 1e3
    np.testing.assert_allclose(front.kappa, raw * (1e3 / floor), rtol=1e-5)
    assert front.kappa[front.extrema[-1, 1], front.extrema[-1, 0]] == pytest.approx(1e3, rel=1e-5)


@pytest.mark.parametrize(
    ("settings", "floor"),
    [({"wanted": 5}, 0.15), ({"wanted": 10**6}, 0.02), ({"wanted": 10**6, "lowest_curvature": 0.4}, 0.4)],
    ids=["textured", "plain", "lowest above the usual"],
)
def test_the_floor_stays_between_its_bounds(settings, floor):
    config, frame = with_extrema(**settings), frames()[1]
    front, raw = FrontEnd(config).process(frame), curvature(frame.image, config.curvature)
    np.testing.assert_allclose(front.kappa, raw * (0.15 / floor), rtol=1e-5)
    np.testing.assert_array_equal(front.extrema, detect_extrema(raw, replace(config.extrema, min_curvature=floor)))


def test_a_noisy_picture_has_its_floor_above_the_noise():
    clean, config = frames()[1], Config()
    assert len(FrontEnd(config).process(clean).extrema) > 100
    counts = []
    for deviation in (3.0, 6.0, 12.0):
        grey = Frame(0, 0, np.clip(128 + deviation * np.random.default_rng(1).standard_normal((240, 320)), 0, 255).astype(np.uint8))
        counts.append([len(FrontEnd(c).process(grey).extrema) for c in (config, with_extrema(noise_curvature=0.0))])
    with_floor, without = zip(*counts, strict=True)
    assert max(with_floor) < 5 and without[2] > 300


def test_unblurred_and_empty_pictures_pass():
    unblurred = replace(Config(), curvature=replace(Config().curvature, smoothing_sigma_px=0.0))
    assert len(FrontEnd(unblurred).process(frames()[0]).extrema) > 100
    black = FrontEnd(Config()).process(Frame(0, 0, np.zeros((240, 320), np.uint8)))
    assert len(black.extrema) == 0 and (black.kappa == 0).all()


def test_each_frame_follows_the_one_before_until_the_picture_is_another():
    for config, expected in ((Config(), [None, 9, None, None, 11]), (paper_config(), [None, 9, 11, 12, 14])):
        front_end, (a, b) = FrontEnd(config), frames()
        stray = texture(240, 320, np.random.default_rng(4), 6.0)
        pictures = ((9, a.image), (11, b.image), (12, stray), (14, np.zeros_like(stray)), (15, b.image))
        fronts = [front_end.process(Frame(index, index, picture)) for index, picture in pictures]
        assert [front.follows for front in fronts] == expected
        if config.continuity.enabled:
            assert [front.dense_flow is None for front in fronts] == [follows is None for follows in expected]
            assert np.abs(fronts[4].dense_flow).max() < 0.5  # from the frame followed


def test_steps_are_timed_once_per_frame():
    front_end = FrontEnd(Config())
    for frame in frames():
        front_end.process(frame)
    assert {step: len(values) for step, values in front_end.times.milliseconds.items()} == {"curvature_extrema": 2, "flow": 2}


def test_only_the_same_picture_again_is_a_repeat(demo):
    front_end, pictures = FrontEnd(Config()), [demo.read(0).image, demo.read(0).image.copy(), demo.read(1).image]
    pictures.append(np.where(np.arange(pictures[2].shape[1]) == 5, pictures[2] ^ 1, pictures[2]).astype(np.uint8))
    found = [front_end.process(Frame(k, k, picture)).is_repeat for k, picture in enumerate(pictures)]
    assert found == [False, True, False, False]
