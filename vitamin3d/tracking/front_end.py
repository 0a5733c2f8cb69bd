# SPDX-License-Identifier: Apache-2.0
"""The part of the front end that needs pixels only, so that a thread can run it ahead of the map."""

from dataclasses import replace

import cv2
import numpy as np

from vitamin3d.config import Config
from vitamin3d.image.curvature import curvature, curvature_of, smoothed
from vitamin3d.image.extrema import detect_extrema
from vitamin3d.image.noise_floor import curvature_floor, lowest_floor, noise_deviation, smoothing_for
from vitamin3d.image.significance import is_significant, significance
from vitamin3d.tracking.continuity import FlowTracker
from vitamin3d.tracking.dominant_flow import CoarseFeatures, coarse_features, estimate_dominant_flow
from vitamin3d.types import Array, DominantFlow, Frame, FrontEndFrame, StepTimes

DESCENT_ITERATIONS = 8
PATCH_REFERENCE_PX = 300.0
"""Square root of the area of the reduced pictures for which the settings' patches are meant: 376 × 240."""
LEAST_PATCH_PX, LARGEST_PATCH_PX = 4, 16
"""OpenCV's DIS borders its pictures with 16 pixels: with larger patches it reads memory that nobody wrote."""
NOISE_MEMORY = 0.9
"""The blur follows the noise of many pictures: extrema move with it."""
IDENTITY_FLOW = DominantFlow(np.eye(2), np.zeros(2), 0.0)


def dense_flow_solver(config: Config, shape: tuple[int, int], patient: bool = False) -> cv2.DISOpticalFlow:
    """OpenCV's DIS at the settings' size, for reduced pictures of a shape (h, w); a patient one is an octave finer and takes its time."""
    settings, size = config.extrema_tracking, float(np.sqrt(shape[0] * shape[1]) / PATCH_REFERENCE_PX)
    dis: cv2.DISOpticalFlow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
    octave = settings.flow_octave - round(float(np.log2(settings.flow_reduction)))
    dis.setFinestScale(max(0, octave - 1 if patient else octave))
    dis.setGradientDescentIterations(2 * DESCENT_ITERATIONS if patient else DESCENT_ITERATIONS)
    dis.setVariationalRefinementIterations(settings.flow_refinements)
    patch = min(LARGEST_PATCH_PX, max(LEAST_PATCH_PX, round(size * settings.flow_patch)))
    stride = min(patch, max(1, round(size * settings.flow_stride)))
    dis.setPatchSize(patch)
    dis.setPatchStride(min(stride, patch // 2) if patient else stride)
    return dis


class FrontEnd:
    """Turns consecutive frames into curvature, extrema and flow; remembers the pictures that the next may continue, reduced."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.times = StepTimes()
        self._flow: FlowTracker | None = None
        self._features: CoarseFeatures | None = None
        self._dominant_flow = IDENTITY_FLOW
        self._previous: int | None = None
        self._picture: Array | None = None
        self._noise: float | None = None

    def process(self, frame: Frame) -> FrontEndFrame:
        """Curvature (Eq. 1), its maxima (Sec. 2.1) and the flow since the frame that it continues (Sec. 2.2)."""
        with self.times.timed("flow"):
            flow, follows = None, self._previous
            if self.config.extrema_tracking.prediction == "dense_flow":
                flow, follows = self._dense_flow(frame)
            else:
                self._update_dominant_flow(frame.image)
        with self.times.timed("curvature_extrema"):
            kappa, extrema = self._extrema(frame.image, self._flow is None or self._flow.is_exact)
        is_repeat = self._picture is not None and np.array_equal(self._picture, frame.image)
        self._previous, self._picture = frame.index, frame.image
        return FrontEndFrame(frame, kappa, extrema, self._dominant_flow, flow, follows, self._noise or 0.0, is_repeat)

    def _extrema(self, image: Array, is_exact: bool) -> tuple[Array, Array]:
        """Curvature in the unit of its floor, and the maxima above that, strongest first; all of them where the step was large."""
        config = self.config.extrema
        if config.wanted == 0:
            kappa = curvature(image, self.config.curvature)
            return kappa, detect_extrema(kappa, config)
        noise = noise_deviation(image)
        self._noise = noise if self._noise is None else NOISE_MEMORY * self._noise + (1.0 - NOISE_MEMORY) * noise
        smoothing = smoothing_for(self._noise, self.config.curvature)
        f, lowest = smoothed(image, smoothing), lowest_floor(noise, smoothing.smoothing_sigma_px, config)
        kappa = curvature_of(f)
        extrema = detect_extrema(kappa, replace(config, min_curvature=lowest))
        if config.significance > 0.0 and is_exact:
            extrema = extrema[is_significant(significance(f, kappa, extrema, smoothing.smoothing_sigma_px), config)]
        strengths = kappa[extrema[:, 1], extrema[:, 0]]
        floor = curvature_floor(strengths, lowest, config)
        kappa *= np.float32(config.min_curvature / floor)
        return kappa, extrema[: int((strengths >= floor).sum())]

    def _dense_flow(self, frame: Frame) -> tuple[Array | None, int | None]:
        """The flow (h, w, 2) and the index of the frame that it comes from."""
        picture = self._reduced(frame.image)
        if self._flow is None:
            shape = picture.shape[0], picture.shape[1]
            quick, patient = dense_flow_solver(self.config, shape), dense_flow_solver(self.config, shape, patient=True)
            self._flow = FlowTracker(quick, patient, self.config.continuity)
        return self._flow.follow(frame.index, picture)

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
