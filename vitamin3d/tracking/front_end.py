# SPDX-License-Identifier: Apache-2.0
"""The part of the front end that needs pixels only, so that a thread can run it ahead of the map."""

import cv2
import numpy as np

from vitamin3d.config import Config
from vitamin3d.tracking.curvature import curvature
from vitamin3d.tracking.dominant_flow import CoarseFeatures, coarse_features, estimate_dominant_flow
from vitamin3d.tracking.extrema import detect_extrema
from vitamin3d.types import Array, DominantFlow, Frame, FrontEndFrame, StepTimes

FINEST_OCTAVE, DESCENT_ITERATIONS = 2, 8
"""DIS stops at a quarter of the picture's size, whatever it is given."""
IDENTITY_FLOW = DominantFlow(np.eye(2), np.zeros(2), 0.0)


class FrontEnd:
    """Turns consecutive frames into curvature, extrema and flow; remembers the previous picture, reduced."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.times = StepTimes()
        self._dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)  # type: ignore[attr-defined]
        self._dis.setFinestScale(max(0, FINEST_OCTAVE - round(float(np.log2(config.extrema_tracking.flow_reduction)))))
        self._dis.setGradientDescentIterations(DESCENT_ITERATIONS)
        self._reduced: Array | None = None
        self._features: CoarseFeatures | None = None
        self._dominant_flow = IDENTITY_FLOW

    def process(self, frame: Frame) -> FrontEndFrame:
        """Curvature (Eq. 1), its maxima (Sec. 2.1) and the flow since the previous frame (Sec. 2.2)."""
        with self.times.timed("curvature_extrema"):
            kappa = curvature(frame.image, self.config.curvature)
            extrema = detect_extrema(kappa, self.config.extrema)
        with self.times.timed("flow"):
            flow = self._dense_flow(frame.image)
            if self.config.extrema_tracking.prediction == "dominant_flow":
                self._update_dominant_flow(frame.image)
        return FrontEndFrame(frame, kappa, extrema, self._dominant_flow, flow)

    def _dense_flow(self, image: Array) -> Array | None:
        """DIS flow (h, w, 2) from the previous picture, reduced, where the settings ask for it and there is one to match."""
        if self.config.extrema_tracking.prediction != "dense_flow":
            return None
        reduction = self.config.extrema_tracking.flow_reduction
        height, width = (n // reduction for n in image.shape)
        whole = image[: height * reduction, : width * reduction]  # so that the reduction is exact
        previous, self._reduced = self._reduced, cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
        return None if previous is None else np.asarray(self._dis.calc(previous, self._reduced, None))

    def _update_dominant_flow(self, image: Array) -> None:
        features = coarse_features(image, self.config.dominant_flow)
        self._dominant_flow = estimate_dominant_flow(self._features, features, self._dominant_flow, self.config.dominant_flow)
        self._features = features
