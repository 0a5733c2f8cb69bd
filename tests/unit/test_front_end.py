# SPDX-License-Identifier: Apache-2.0
import numpy as np
from scenes import texture, warped

from vitamin3d.config import Config, paper_config
from vitamin3d.tracking.curvature import curvature
from vitamin3d.tracking.extrema import detect_extrema
from vitamin3d.tracking.front_end import FrontEnd
from vitamin3d.types import Frame

SHIFT = np.array([4.0, -3.0])


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


def test_the_paper_uses_dominant_flow_instead():
    front_end = FrontEnd(paper_config())
    first, second = (front_end.process(frame) for frame in frames())
    assert first.dense_flow is None and second.dense_flow is None
    center = np.array([160.0, 120.0])
    np.testing.assert_allclose(second.dominant_flow.A @ center + second.dominant_flow.b, center + SHIFT, atol=2.0)
    assert second.dominant_flow.inlier_ratio > 0.5


def test_curvature_and_extrema_are_those_of_the_frame():
    config = Config()
    frame = frames()[1]
    front = FrontEnd(config).process(frame)
    assert front.frame is frame
    np.testing.assert_array_equal(front.kappa, curvature(frame.image, config.curvature))
    np.testing.assert_array_equal(front.extrema, detect_extrema(front.kappa, config.extrema))
    assert len(front.extrema) > 20


def test_steps_are_timed_once_per_frame():
    front_end = FrontEnd(Config())
    for frame in frames():
        front_end.process(frame)
    assert {step: len(values) for step, values in front_end.times.milliseconds.items()} == {"curvature_extrema": 2, "flow": 2}
