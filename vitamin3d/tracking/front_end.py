# SPDX-License-Identifier: Apache-2.0
"""The part of the front end that needs pixels only, so that a thread can run it ahead of the map."""

from dataclasses import replace

import cv2
import numpy as np

from vitamin3d.config import Config
from vitamin3d.tracking.continuity import FlowTracker
from vitamin3d.tracking.curvature import curvature
from vitamin3d.tracking.dominant_flow import CoarseFeatures, coarse_features, estimate_dominant_flow
from vitamin3d.tracking.extrema import detect_extrema
from vitamin3d.tracking.noise_floor import curvature_floor, lowest_floor, noise_deviation, smoothing_for
from vitamin3d.types import Array, DominantFlow, Frame, FrontEndFrame, StepTimes

DESCENT_ITERATIONS = 8
NOISE_MEMORY = 0.9
"""The blur follows the noise of many pictures: extrema move with it."""
IDENTITY_FLOW = DominantFlow(np.eye(2), np.zeros(2), 0.0)


def dense_flow_solver(config: Config) -> cv2.DISOpticalFlow:
    """OpenCV's DIS at the settings' size."""
    dis: cv2.DISOpticalFlow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
    dis.setFinestScale(max(0, config.extrema_tracking.flow_octave - round(float(np.log2(config.extrema_tracking.flow_reduction)))))
    dis.setGradientDescentIterations(DESCENT_ITERATIONS)
    dis.setPatchSize(config.extrema_tracking.flow_patch)
    dis.setPatchStride(config.extrema_tracking.flow_stride)
    return dis


class FrontEnd:
    """Turns consecutive frames into curvature, extrema and flow; remembers the pictures that the next may continue, reduced."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.times = StepTimes()
        self._flow = FlowTracker(dense_flow_solver(config), dense_flow_solver(config), config.continuity)
        self._features: CoarseFeatures | None = None
        self._dominant_flow = IDENTITY_FLOW
        self._previous: int | None = None
        self._noise: float | None = None

    def process(self, frame: Frame) -> FrontEndFrame:
        """Curvature (Eq. 1), its maxima (Sec. 2.1) and the flow since the frame that it continues (Sec. 2.2)."""
        with self.times.timed("curvature_extrema"):
            kappa, extrema = self._extrema(frame.image)
        with self.times.timed("flow"):
            flow, follows = None, self._previous
            if self.config.extrema_tracking.prediction == "dense_flow":
                flow, follows = self._flow.follow(frame.index, self._reduced(frame.image))
            else:
                self._update_dominant_flow(frame.image)
        self._previous = frame.index
        return FrontEndFrame(frame, kappa, extrema, self._dominant_flow, flow, follows, self._noise or 0.0)

    def _extrema(self, image: Array) -> tuple[Array, Array]:
        """Curvature in the unit of its floor, and the maxima above that, strongest first."""
        config = self.config.extrema
        if config.wanted == 0:
            kappa = curvature(image, self.config.curvature)
            return kappa, detect_extrema(kappa, config)
        noise = noise_deviation(image)
        self._noise = noise if self._noise is None else NOISE_MEMORY * self._noise + (1.0 - NOISE_MEMORY) * noise
        smoothing = smoothing_for(self._noise, self.config.curvature)
        kappa, lowest = curvature(image, smoothing), lowest_floor(noise, smoothing.smoothing_sigma_px, config)
        extrema = detect_extrema(kappa, replace(config, min_curvature=lowest))
        strengths = kappa[extrema[:, 1], extrema[:, 0]]
        floor = curvature_floor(strengths, lowest, config)
        kappa *= np.float32(config.min_curvature / floor)
        return kappa, extrema[: int((strengths >= floor).sum())]

    def _reduced(self, image: Array) -> Array:
        reduction = self.config.extrema_tracking.flow_reduction
        height, width = (n // reduction for n in image.shape)
        whole = image[: height * reduction, : width * reduction]  # so that the reduction is exact
        small, blur = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), self.config.extrema_tracking.flow_blur_px
        return np.asarray(cv2.GaussianBlur(small, (0, 0), blur) if blur > 0 else small)

    def _update_dominant_flow(self, image: Array) -> None:
        features = coarse_features(image, self.config.dominant_flow)
        self._dominant_flow = estimate_dominant_flow(self._features, features, self._dominant_flow, self.config.dominant_flow)
        self._features = features
