# SPDX-License-Identifier: Apache-2.0
"""Every number of the method, one frozen dataclass per step; each step receives only its own.

`Config()` is what measured best; `paper_config()` is the literal paper (its unpublished constants filled in).
`dump_toml` writes all of it, `load_toml` reads it back and refuses names it does not know.
"""

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vitamin3d.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CHOICES = {
    "extrema_tracking.prediction": ("dense_flow", "dominant_flow"),
    "bundle_adjustment.keyframe_solver": ("subspace-accelerated", "schur", "subspace", "subspace-inner"),
    "window.past": ("anchors", "prior"),
    "fusion.backend": ("blocks", "scalable"),
    "calibration.refine": ("auto", "on", "off"),
}
AT_LEAST_ONE = (
    "continuity.reduction",
    "relocalization.interval",
    "relocalization.keyframes",
    "relocalization.stride",
    "extrema.refill_interval",
    "dominant_flow.reduction",
    "extrema_tracking.flow_reduction",
    "extrema_tracking.flow_patch",
    "extrema_tracking.flow_stride",
    "initialization.history",
    "atlas.max_heritage",
    "motion_check.interval",
    "motion_check.max_pairs",
    "recovery.interval",
    "bundle_adjustment.keyframe_interval",
    "window.keyframes",
    "calibration.max_keyframes",
    "calibration.readout_blocks",
    "densification.keyframe_stride",
    "densification.max_views",
    "densification.max_stride",
    "densification.reach",
    "extrapolation.neighbours",
    "consistency.first",
    "consistency.spacing",
    "consistency.per_side",
)


@dataclass(frozen=True)
class CurvatureConfig:
    """Sec. 2.1, Eq. 1."""

    smoothing_sigma_px: float = 1.9
    """Of the Gaussian blur before the derivatives;"""
    max_smoothing_sigma_px: float = 2.8
    """where the picture is noisy it widens up to this,"""
    smoothing_per_noise: float = 0.3
    """by so many pixels per grey level of noise above"""
    quiet_noise: float = 2.0
    """grey levels (standard deviation)."""


@dataclass(frozen=True)
class ExtremaConfig:
    """Sec. 2.1: which maxima of the curvature become tracks."""

    min_curvature: float = 0.15
    """Floor of kappa, grey levels³ per pixel⁴ of the smoothed 0–255 image."""
    wanted: int = 3000
    """With fewer maxima above it the floor sinks, 0: never;"""
    lowest_curvature: float = 0.02
    """but not below this,"""
    noise_curvature: float = 0.004
    """nor below this many times the third power of the deviation of the picture's noise. Curvatures are then scaled to `min_curvature`."""
    significance: float = 5.0
    """Deviations of the noise by which gradient and bend of a maximum stand above it, 0: any;"""
    significant_wanted: int = 1000
    """where fewer maxima do, the most significant ones up to this number,"""
    significant_share: float = 0.35
    """or this share of all, where that is more."""
    min_roundness: float = 0.65
    """4 det / trace² of kappa's Hessian at the maximum: on a ridge (0) it slides, on a round hill (1) it stays; 0: all maxima."""
    max_tracks: int = 9000
    refill_interval: int = 1
    """Frames between two refills with free extrema."""
    min_distance_px: float = 3.0
    """New extrema keep this distance from live tracks and from each other."""
    border_px: int = 8


@dataclass(frozen=True)
class DominantFlowConfig:
    """Sec. 2.2."""

    reduction: int = 6
    max_features: int = 500
    sigma_px: float = 1.0
    """Scale of Geman–McClure, pixels of the reduced image."""
    iterations: int = 20
    min_matches: int = 12
    min_inlier_ratio: float = 0.25


@dataclass(frozen=True)
class ExtremaTrackingConfig:
    """Sec. 2.3."""

    prediction: str = "dense_flow"
    """`dominant_flow` (Eq. 4, the paper) or `dense_flow` (DIS flow, several times more survivors)."""
    flow_reduction: int = 2
    """The dense flow is computed on the picture reduced by this."""
    prediction_weight: float = 0.3
    """lambda of Eq. 5, relative to the noise floor's unit of kappa."""
    prediction_sigma_px: float = 3.0
    """sigma of w in Eq. 5."""
    max_steps: int = 10
    flow_octave: int = 2
    """The finest octave of the dense flow: 0 the picture's own pixels, 1 half of them in each direction, ..."""
    flow_patch: int = 12
    """Side of the patches that the dense flow is found by, pixels of a reduced picture of 376 × 240, in others in proportion; large ones
    slide less along edges and follow noise less,"""
    flow_stride: int = 6
    """and their distance."""
    flow_refinements: int = 5
    """Variational steps at each octave, after the patches: between them the flow is smooth, and follows the edges."""
    flow_blur_px: float = 1.25
    """Deviation of the blur of the reduced pictures before the flow is computed."""
    gate_px: float = 1.05
    """A climb that ends farther from the prediction is a miss: where the flow is exact, a far extremum is another one."""
    gate_medians: float = 1.25
    """The gate is as wide as this many medians of the distances, where that is more: the flow is not equally exact in all pictures."""
    max_gate_px: float = 2.5
    min_roundness: float = 0.2
    """As of the extrema; a climb that ends on a maximum less round is a miss."""
    coast_frames: int = 4
    """Frames in a row that a track may live on its prediction."""


@dataclass(frozen=True)
class ContinuityConfig:
    """Which picture goes on from which: the one before, moved by the flow, must look like it on a coarse grid. Not in the paper."""

    enabled: bool = True
    """With `extrema_tracking.prediction = "dense_flow"` only."""
    reduction: int = 4
    """Of the grid, beyond the flow's own."""
    min_contrast: float = 1.5
    """Grey levels on the grid; a picture with less shows nothing (a covered lens)."""
    good_correlation: float = 0.97
    """Below it the flow is tried once more, beginning with a homography of matched corners: large steps, dropped pictures."""
    large_step: float = 0.02
    """Median flow, in sizes of the picture (square root of its area), above which that is tried as well;"""
    largest_step: float = 0.15
    """and above which a flow that no corners confirm is none."""
    min_correlation: float = 0.6
    """Below it the picture goes on from another one, or from none: a cut, a stray picture."""
    max_gap: int = 90
    """Frames after which the last picture before such a break is given up."""
    corners: int = 1000
    min_matches: int = 25
    """That agree on the homography."""


@dataclass(frozen=True)
class InitializationConfig:
    """Sec. 5.1: when two frames become the first map."""

    min_motion_px: float = 18.0
    min_parallax_deg: float = 0.6
    """Median over the triangulated points."""
    max_parallax_ratio: float = 3.0
    """Of that parallax over the median angle that the best rotation alone leaves: above it a turn explains the pictures as well,"""
    turn_deg: float = 0.6
    """where it leaves less than this."""
    ransac_threshold_px: float = 1.0
    min_tracks: int = 100
    min_inlier_ratio: float = 0.5
    min_triangulated_ratio: float = 0.5
    min_surviving_ratio: float = 0.12
    """Below this share of the reference's tracks, a later frame becomes the reference."""
    history: int = 90
    """Frames kept from which references are taken."""


@dataclass(frozen=True)
class LocalizationConfig:
    """Sec. 5.1: P3P RANSAC and the refinement of a frame's pose."""

    prior_inlier_ratio: float = 0.6
    """Where the motion model explains this share of the landmarks, RANSAC is skipped; above 1: never."""
    ransac_points: int = 400
    ransac_iterations: int = 100
    ransac_threshold_px: float = 4.0
    sigma_px: float = 2.0
    iterations: int = 12
    outlier_px: float = 4.0
    """A landmark whose track is farther from its projection ends the track; and one farther than outlier_medians times
    the frame's median error, but not below min_outlier_px: exact pictures deserve a stricter gate than shaky ones."""
    outlier_medians: float = 4.0
    min_outlier_px: float = 1.0
    min_inliers: int = 30
    min_inlier_ratio: float = 0.25
    min_kept_ratio: float = 0.1
    """Inliers over all tracks of landmarks, those that coast included; below it the picture has jumped."""
    votes: int = 8
    """Landmarks with so many observations in keyframes localise the camera; the others must agree with them. Extrema that slide
    along an edge look like parallax, and are soon many."""
    min_voters: int = 60
    """With fewer of them landmarks with half the observations vote too, then with a quarter, then all."""
    loose_observations: int = 4
    """A pose is uncertain where fewer landmarks with so many observations"""
    min_known: int = 10
    """than this agree on it: nothing is added to the map then;"""
    max_loose_frames: int = 10
    """after so many such frames in a row the camera counts as lost."""


@dataclass(frozen=True)
class RotationConfig:
    """A camera that turns without travelling is followed as that, by tracks without depth. Not in the paper."""

    enabled: bool = True
    min_tracks: int = 50
    """That agree on the rotation;"""
    min_share: float = 0.4
    """and this share of all: parallax disagrees; before there is a map, and"""
    min_share_in_map: float = 0.5
    """this share where its frame is placed in a map;"""
    min_old_share: float = 0.8
    """and of the older half of the tracks this many times as large a share,"""
    max_doubts: int = 5
    """except in so many frames in a row; so many tries to initialise in a row must show parallax as well."""
    sigma_px: float = 1.0
    """Of the directions of tracks, and"""
    sigma_deg: float = 0.125
    """the same as an angle, where that is more: a turn in the hand shifts the camera a little."""
    max_shift: float = 0.2
    """Of the median depth: a camera found farther than this from where a turn began has done more, and the turn's frames are given up."""
    max_parallax_deg: float = 0.4
    """Median, of a try to initialise; above it the camera has travelled."""
    min_turn_deg: float = 5.0
    """Of a camera without a map that is said to turn."""


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe."""

    motion_px: float = 10.0
    """Median motion of the landmarks since the last keyframe."""
    min_tracked_ratio: float = 0.5
    """A keyframe is also due when fewer of the last keyframe's landmarks are still tracked."""
    min_gap: int = 1


@dataclass(frozen=True)
class TriangulationConfig:
    """Sec. 5.1: when a track becomes a landmark."""

    min_parallax_deg: float = 0.5
    """Between its first and its newest observation, and"""
    parallax_deviations: float = 10.0
    """this many deviations of the two cameras' places, as angles: an error of the pose looks like parallax, and makes a scale."""
    max_reprojection_px: float = 3.0
    max_rms_px: float = 1.5
    """Of all its observations in the last `checked_keyframes`; 0: the first and the newest alone are looked at."""
    checked_keyframes: int = 40
    min_observations: int = 2


@dataclass(frozen=True)
class MotionCheckConfig:
    """The map's newest motion against the one that the tracks of two of its keyframes tell by themselves. Not in the paper.

    A map may be bent, all its landmarks agreeing with false poses; no adjustment leaves such a minimum.
    """

    enabled: bool = True
    interval: int = 4
    """Keyframes between two checks."""
    max_keyframes: int = 24
    """Between the two that are compared,"""
    min_pairs: int = 50
    """with so many landmarks seen in both,"""
    min_share: float = 0.25
    """and this share of those seen in the newest;"""
    max_pairs: int = 150
    """at most so many of them are looked at."""
    sigma_px: float = 1.0
    """Of the Geman–McClure cost of the epipolar distances."""
    sound_ratio: float = 1.2
    """The map's cost over the least; up to here the map is sound,"""
    bent_ratio: float = 1.8
    """from here on bent, where its motion differs from the best"""
    min_turn_deg: float = 1.0
    """by so much in rotation"""
    min_direction_deg: float = 15.0
    """or so much in the direction of the way,"""
    max_doubts: int = 1
    """in more than so many checks since the last sound one."""
    min_pairs_of_a_link: int = 25
    """That two keyframes share to link the newer one to those before: what nothing links has a scale of its own;"""
    linked_ratio: float = 1.35
    """the map's motion between them may be so much dearer."""


@dataclass(frozen=True)
class RecoveryConfig:
    """Landmarks that come back into view are found again."""

    enabled: bool = True
    interval: int = 2
    """Frames between two searches."""
    max_view_angle_deg: float = 32.0
    max_distance_ratio: float = 1.25
    gate_px: float = 3.0
    min_zncc: float = 0.85
    merge_distance: float = 0.0
    """A landmark that meets a tracked one becomes one with it where they are this near in space, relative to the depth (0.02, say);
    0: never. Of the copies of a place each is one more measurement: merging gained nothing on exact pictures and cost real ones."""
    min_observations: int = 3


@dataclass(frozen=True)
class RelocalizationConfig:
    """The camera found again by descriptors, when its tracks broke."""

    enabled: bool = True
    keyframes: int = 6
    """So many are tried at a time: the newest, later older ones."""
    stride: int = 4
    """Of the older keyframes every so many-th is remembered,"""
    max_remembered: int = 60
    """so many at most."""
    tries_at_once: int = 3
    """In the first so many lost frames; then"""
    interval: int = 5
    """in each so many-th."""
    corners: int = 1500
    max_distance_px: float = 3.0
    """Between a keyframe's corner and the landmark that it lends."""
    min_inliers: int = 25
    min_inlier_ratio: float = 0.1
    ransac_iterations: int = 500
    gate_px: float = 6.0
    """Of the first search for the landmarks around their projections."""


@dataclass(frozen=True)
class AtlasConfig:
    """When a map is kept."""

    min_keyframes: int = 5
    """A map that is lost with fewer, or with fewer frames localised, is dropped and made anew."""
    min_frames: int = 10
    min_rigid_share: float = 0.25
    """And one in which fewer of the tracks that show parallax become landmarks: it may be that of something that moves, or of a turn;"""
    judged_tracks: int = 500
    """after so many such tracks."""
    frames_beside: int = 30
    """The next map goes on beside one in which the camera was found again, so long;"""
    max_heritage: int = 60
    """The newest frames of a map in which the camera is lost, with which the next one may begin."""


@dataclass(frozen=True)
class WindowConfig:
    """Which keyframes take part in an adjustment."""

    keyframes: int = 24
    past: str = "anchors"
    """What holds the window: `anchors`, or `prior`: what keyframes knew when they left it (cheaper in long maps, less accurate)."""
    anchors: int = 60
    """Older keyframes, poses fixed, that share most landmarks with the window."""
    min_shared_landmarks: int = 20
    settled_keyframes: int = 0
    """A keyframe goes to the dense half when so many newer ones are there; 0: when it has left the window."""
    settled_frames: int = 0
    """Or when so many frames came after it, where the camera rests; 0: never for that reason."""


@dataclass(frozen=True)
class BundleAdjustmentConfig:
    """Sec. 3, Eq. 6–12."""

    sigma_px: float = 2.0
    sweeps_per_frame: int = 0
    """Subspace Gauss–Newton sweeps over the newest keyframes and the frame's landmarks, at every frame (Eq. 11–12). Where frames are
    localised by thousands of landmarks they gain little."""
    keyframe_solver: str = "subspace-accelerated"
    """Solver of the window at each keyframe: `subspace-accelerated` (cameras together with the points eliminated, then each
    point alone), `schur` (the former only), `subspace` (Eq. 11–12) or `subspace-inner` (several sweeps with the same derivatives)."""
    keyframe_interval: int = 4
    """The window is adjusted at every so many-th keyframe: a long window now and then holds better than a short one each time."""
    keyframe_iterations: int = 6
    relative_gain: float = 1e-3
    """An adjustment ends when a step lowers the cost by less than this share."""
    points_per_keyframe: int = 250
    """About so many points of each keyframe, those of the longest tracks, are adjusted together with the cameras at a keyframe;
    the others are then moved to them. 0: all."""
    frame_keyframes: int = 4
    """Keyframes that are adjusted with every frame;"""
    frame_anchors: int = 36
    """so many before them are their anchors."""
    outlier_px: float = 5.0


@dataclass(frozen=True)
class FinalAdjustmentConfig:
    """The adjustment of the whole map at the end, with all observations and stricter than the windows'; then its outliers go."""

    enabled: bool = True
    sigma_px: float = 1.0
    outlier_px: float = 3.0
    iterations: int = 6
    relative_gain: float = 1e-2
    max_keyframes: int = 1000
    """Longer maps are left as they are: the reduced camera system grows with the square of the keyframes."""


@dataclass(frozen=True)
class CalibrationConfig:
    """The camera's parameters as variables of adjustments of the whole map."""

    refine: str = "auto"
    """`auto`: where the motion determines them; `on`: whatever comes out; `off`."""
    parameters: str = "f k1"
    """Free ones out of f fx fy cx cy k1 k2 p1 p2; `f` moves fx and fy together."""
    first_keyframes: int = 20
    growth: float = 3.0
    """The next refinement is due when the map has grown by this factor; one more comes at the end."""
    max_keyframes: int = 120
    """Of a longer map so many keyframes take part, spread evenly; the others are then moved to the new camera."""
    readout: bool = True
    """The readout time of a rolling shutter is looked for as well."""
    readout_points: int = 150
    """Landmarks per keyframe that take part in that."""
    readout_blocks: int = 3
    """Of 60 consecutive keyframes, spread over the map: so many at most."""
    readout_systematic_factor: float = 5.0
    max_readout_deviation: float = 0.3
    """In intervals between two frames, systematic errors included; above it the motion does not determine the readout time."""
    settled_readout_deviation: float = 0.06
    """In intervals as well; below it, a camera that reads all rows at once is one, and its readout time is not looked for again."""
    points_per_keyframe: int = 200
    """Landmarks with the most observations that take part, about so many in each keyframe."""
    sigma_px: float = 1.0
    iterations: int = 12
    prior_focal: float = 0.05
    """Standard deviation of the focal length around the one before, relative."""
    prior_distortion: float = 0.1
    systematic_factor: float = 10.0
    """True deviations over those of independent errors: rolling shutter, tracks cut short, the model of the lens."""
    max_focal_deviation: float = 0.02
    """Relative, systematic errors included; above it the motion does not determine the focal length."""
    significance: float = 3.0
    """Deviations by which the parameters together must differ from the given ones before `auto` believes that those are wrong."""
    max_change: float = 0.25
    """Of the focal length from the given one, relative."""


@dataclass(frozen=True)
class MemoryConfig:
    """When a map is condensed, so that a run without end fits into memory."""

    max_keyframes: int = 1200
    """Above it, keyframes whose landmarks others see too are dropped."""
    dropped_share: float = 0.15
    """Of max_keyframes, at a time."""
    max_new_tracks: int = 1_000_000
    """When so many were born, those that ended and are no landmarks are forgotten."""
    min_observations: int = 3
    """And landmarks out of view that have fewer: they are neither found again nor exported."""


@dataclass(frozen=True)
class CloudConfig:
    """Filter of the exported cloud."""

    min_observations: int = 3
    min_parallax_deg: float = 1.0
    max_reprojection_rms_px: float = 1.5


@dataclass(frozen=True)
class SnapshotConfig:
    """Which landmarks become vertices of a keyframe's mesh."""

    min_observations: int = 3
    min_observation_sigma_px: float = 0.1
    shared_error: float = 0.55
    """What a landmark's observations have in common does not average out: the variance of a residual times 1 + this × their number."""
    max_relative_deviation: float = 0.5
    max_reprojection_rms_px: float = 1.5


@dataclass(frozen=True)
class DensificationConfig:
    """Depths of textured pixels between the landmarks, from neighbouring keyframes; not in the paper."""

    enabled: bool = True
    keyframe_stride: int = 2
    """Every so many-th keyframe is densified and fused, the others serve as its neighbours;"""
    max_views: int = 80
    """where a finished map would then give more, at larger steps,"""
    max_stride: int = 5
    """but at least every so many-th;"""
    view_motion_px: float = 120.0
    """and one in between where the last one's landmarks have moved by so many pixels (their median)."""
    reach: int = 13
    """Keyframes before and after among which neighbours are looked for."""
    max_wait_s: float = 0.0
    """A keyframe waits no longer for later neighbours when the camera is so many seconds further; 0: however long it takes."""
    near_parallax_deg: float = 3.0
    """Two neighbours on each side, with about these parallaxes."""
    far_parallax_deg: float = 6.0
    min_overlap: float = 0.5
    """Share of the landmarks that a neighbour must see."""
    min_landmarks: int = 30
    planes: int = 40
    small_penalty: float = 5.0
    """Of a step to the next plane, in bits of the census."""
    edge_penalty: float = 50.0
    """Of a larger step, where the picture has no edge."""
    cell_px: int = 6
    """One pixel per cell at most becomes a vertex."""
    min_distinctness: float = 1.3
    """Aggregated cost of the best other plane over the winner's."""
    max_cost: float = 16.0
    """Bits of the census in which the winner may differ."""
    patch_px: int = 9
    min_zncc: float = 0.7
    sigma_px: float = 1.0
    """Deviation of a refined match in one neighbour."""
    max_relative_deviation: float = 0.3


@dataclass(frozen=True)
class DelaunayConfig:
    """Sec. 4.2: landmarks to a triangulation of the picture."""

    min_vertices: int = 30
    min_separation_px: float = 1.0
    """Of two landmarks nearer than this in the image, the more certain one becomes a vertex."""
    deviation_floor: float = 0.01
    """Relative, added in quadrature: what landmarks share (poses, calibration) and mismatches are not in their deviations."""


@dataclass(frozen=True)
class NltgvConfig:
    """NLTGV²-L1 on the Delaunay graph (Greene and Roy 2017), diagonal preconditioning (Pock and Chambolle 2011)."""

    enabled: bool = True
    iterations: int = 45
    primal_share: float = 0.03
    """Primal steps are multiplied and dual ones divided by this; 1 takes eight times the iterations."""
    data_weight: float = 4.0
    """lambda."""
    full_deviation: float = 0.02
    """omega of a vertex = full_deviation / relative deviation of its depth."""
    slope_weight: float = 1.0
    """beta."""
    pixel_unit: float = 8.0
    """Pixel coordinates are divided by this, inverse depths by their mean."""


@dataclass(frozen=True)
class ExtrapolationConfig:
    """Vertices on the border of the picture, so that the mesh ends where the picture does; not in the paper."""

    enabled: bool = True
    spacing_px: float = 40.0
    neighbours: int = 8
    """The planes of so many vertices are continued."""
    min_distance_px: float = 3.0
    """To the nearest vertex."""
    max_ratio: float = 2.0
    """Between the inverse depth found and the lowest or highest of these vertices."""
    doubling_px: float = 64.0
    """Distance to the nearest vertex at which the deviation is twice theirs."""


@dataclass(frozen=True)
class DepthRenderingConfig:
    """Sec. 4.2: which triangles become depth."""

    max_inverse_depth_range: float = 0.25
    """A triangle whose inverse depths differ by more, relative to their mean, spans a depth edge."""
    max_slant_deg: float = 80.0
    max_edge_ratio: float = 0.33
    """Longest edge in picture widths."""
    canvas_limit: float = 0.5
    """The canvas reaches beyond the picture, undistorted, by at most so many of its widths and heights on each side."""
    canvas_pixels: float = 1.0
    """And has at most so many times its pixels: those of a lens's corners are spread far, and would be drawn several times."""


@dataclass(frozen=True)
class ConsistencyConfig:
    """Before fusion, the views around a view confirm or contradict its depths: their votes change the weights."""

    enabled: bool = True
    first: int = 1
    """The voters are the views so many before and after in the order of fusion,"""
    spacing: int = 2
    """and the ones so many further,"""
    per_side: int = 2
    """together so many on each side."""
    max_wait_s: float = 0.0
    """A view waits no longer for later voters when the camera is so many seconds further; 0: however long it takes."""
    tolerance: float = 0.02
    """Relative difference of depth up to which a view confirms."""
    contradicted_weight: float = 0.1
    """Factor of a depth that more views contradict than confirm."""

    @property
    def offsets(self) -> tuple[int, ...]:
        """Distances to the voters in the order of fusion."""
        return tuple(self.first + self.spacing * k for k in range(self.per_side))

    @property
    def reach(self) -> int:
        """Distance to the farthest voter."""
        return self.offsets[-1]


@dataclass(frozen=True)
class FusionConfig:
    """Sec. 4.2: the two TSDF volumes."""

    backend: str = "scalable"
    """`scalable`, Open3D's ScalableTSDFVolume, where all pixels that are certain enough weigh the same, or `blocks` (ours), where each
    weighs by its certainty."""
    voxel_low: float | None = None
    """Metres where the scale is known, else map units; None: median depth of the scene / 20 (and / 120)."""
    voxel_high: float | None = None
    depth_per_voxel_low: float = 20.0
    depth_per_voxel_high: float = 120.0
    keyframes_for_depth: int = 20
    """Views whose depths decide the voxels; fusion waits for them where the voxels are not given."""
    truncation_voxels: float = 3.0
    max_relative_deviation: float = 0.055
    """Pixels whose depth has a larger deviation, relative to the depth, are not fused (not of `blocks`)."""
    max_deviation_voxels: float = 4.5
    """The surface ends where all views together leave a larger deviation of the depth (`blocks` alone)."""
    max_depth: float = 3.0
    """Depth beyond this many median depths of the scene is not fused."""


@dataclass(frozen=True)
class RefusionConfig:
    """At the end of a live run, views whose keyframe moved after they were fused are taken out of the volume and fused anew.

    With `fusion.backend = "blocks"` only. Without --live everything is fused after the last adjustment.
    """

    enabled: bool = True
    min_motion_voxels: float = 0.5
    """What a view shows must have moved by so many fine voxels."""
    max_megabytes: float = 1000.0
    """Of views kept in a temporary file; the oldest are forgotten and stay as they were fused."""


@dataclass(frozen=True)
class SurfaceConfig:
    """Cleaning of the extracted meshes."""

    min_component_triangles: int = 200
    """Smaller connected pieces of the fine mesh are removed, and pieces of the same area of the coarse one."""


@dataclass(frozen=True)
class Config:
    """All settings of a run; the page order is the order of the method."""

    mode: str = "default"
    seed: int = 0
    curvature: CurvatureConfig = field(default_factory=CurvatureConfig)
    extrema: ExtremaConfig = field(default_factory=ExtremaConfig)
    dominant_flow: DominantFlowConfig = field(default_factory=DominantFlowConfig)
    extrema_tracking: ExtremaTrackingConfig = field(default_factory=ExtremaTrackingConfig)
    continuity: ContinuityConfig = field(default_factory=ContinuityConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    localization: LocalizationConfig = field(default_factory=LocalizationConfig)
    rotation: RotationConfig = field(default_factory=RotationConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    motion_check: MotionCheckConfig = field(default_factory=MotionCheckConfig)
    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    atlas: AtlasConfig = field(default_factory=AtlasConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    bundle_adjustment: BundleAdjustmentConfig = field(default_factory=BundleAdjustmentConfig)
    final_adjustment: FinalAdjustmentConfig = field(default_factory=FinalAdjustmentConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    memory: MemoryConfig = field(default_factory=MemoryConfig)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    snapshot: SnapshotConfig = field(default_factory=SnapshotConfig)
    densification: DensificationConfig = field(default_factory=DensificationConfig)
    delaunay: DelaunayConfig = field(default_factory=DelaunayConfig)
    nltgv: NltgvConfig = field(default_factory=NltgvConfig)
    extrapolation: ExtrapolationConfig = field(default_factory=ExtrapolationConfig)
    depth_rendering: DepthRenderingConfig = field(default_factory=DepthRenderingConfig)
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    refusion: RefusionConfig = field(default_factory=RefusionConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)


def paper_config() -> Config:
    """The literal paper: affine prediction (Eq. 4), no anchors, nothing found again, subspace Gauss–Newton alone."""
    return Config(
        mode="paper",
        curvature=CurvatureConfig(smoothing_sigma_px=2.5, max_smoothing_sigma_px=2.5),
        extrema=ExtremaConfig(min_roundness=0.0, wanted=0),
        extrema_tracking=ExtremaTrackingConfig(
            prediction="dominant_flow", gate_px=8.0, gate_medians=0.0, min_roundness=0.0, coast_frames=0
        ),
        continuity=ContinuityConfig(enabled=False),
        localization=LocalizationConfig(prior_inlier_ratio=2.0, outlier_medians=100.0, votes=0),
        triangulation=TriangulationConfig(min_parallax_deg=1.0, parallax_deviations=0.0, max_rms_px=0.0),
        rotation=RotationConfig(enabled=False),
        recovery=RecoveryConfig(enabled=False),
        relocalization=RelocalizationConfig(enabled=False),
        window=WindowConfig(keyframes=20, anchors=0),
        final_adjustment=FinalAdjustmentConfig(enabled=False),
        densification=DensificationConfig(enabled=False),
        extrapolation=ExtrapolationConfig(enabled=False),
        consistency=ConsistencyConfig(enabled=False),
        fusion=FusionConfig(max_relative_deviation=1e3),
        calibration=CalibrationConfig(refine="off"),
        bundle_adjustment=BundleAdjustmentConfig(
            sweeps_per_frame=2, keyframe_interval=1, keyframe_solver="subspace", keyframe_iterations=20, points_per_keyframe=0
        ),
    )


def live_config(base: Config) -> Config:
    """`base` for cameras that do not wait: fewer keyframes, and meshes made soon after their pictures.

    Nothing is adjusted again at the end: the mesh is there already; so windows are adjusted sooner, with more points. The volume is
    ours, since Open3D's lets no other thread run while it integrates a view.
    """
    change = dataclasses.replace
    return change(
        base,
        extrema=change(base.extrema, max_tracks=min(5600, base.extrema.max_tracks)),
        continuity=change(base.continuity, large_step=max(0.05, base.continuity.large_step)),
        keyframes=change(base.keyframes, motion_px=20.0),
        window=change(base.window, settled_keyframes=2, settled_frames=10),
        bundle_adjustment=change(
            base.bundle_adjustment,
            sweeps_per_frame=0,
            keyframe_interval=min(3, base.bundle_adjustment.keyframe_interval),
            points_per_keyframe=400 if base.bundle_adjustment.points_per_keyframe else 0,
        ),
        final_adjustment=change(base.final_adjustment, enabled=False),
        calibration=change(base.calibration, refine="off"),
        memory=change(base.memory, max_keyframes=600, max_new_tracks=60_000),
        densification=change(base.densification, reach=3, planes=32, max_wait_s=1.0),
        nltgv=change(base.nltgv, iterations=min(45, base.nltgv.iterations)),
        consistency=change(base.consistency, first=1, per_side=1, max_wait_s=1.25),
        fusion=change(base.fusion, keyframes_for_depth=10, backend="blocks"),
    )


def dump_toml(config: Config) -> str:
    """All settings as TOML text; a value None is left out, as TOML has none."""
    tops, groups = [], []
    for name, value in dataclasses.asdict(config).items():
        if isinstance(value, dict):
            groups.append(f"\n[{name}]\n" + "".join(f"{k} = {_toml_value(v)}\n" for k, v in value.items() if v is not None))
        else:
            tops.append(f"{name} = {_toml_value(value)}\n")
    return "".join(tops + groups)


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def load_toml(path: Path, base: Config | None = None) -> Config:
    """`base` (default: `Config()`) with the settings of a TOML file.

    Raises:
        InputError: the file cannot be read, or holds a name, a type or a value that `Config` does not have.
    """
    try:
        table = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not a readable TOML file ({error}); see `vitamin3d config` for the format") from None
    config: Config = _replaced(base or Config(), table, path, "")
    return config


def _replaced(node: Any, table: dict[str, Any], path: Path, prefix: str) -> Any:
    fields = {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
    changes = {}
    for name, value in table.items():
        if name not in fields:
            raise InputError(f"{path}: unknown setting {prefix}{name}; `vitamin3d config` lists all")
        changes[name] = _coerced(fields[name], value, path, prefix + name)
    return dataclasses.replace(node, **changes)


def _coerced(old: Any, value: Any, path: Path, name: str) -> Any:
    if dataclasses.is_dataclass(old):
        if not isinstance(value, dict):
            raise InputError(f"{path}: {name} is a group of settings, not a value")
        return _replaced(old, value, path, name + ".")
    number = (int, float) if old is None or isinstance(old, float) else type(old)
    if not isinstance(value, number) or isinstance(value, bool) != isinstance(old, bool):
        raise InputError(f"{path}: {name} must be like {old!r}, not {value!r}")
    _check_value(value, path, name)
    return float(value) if isinstance(old, float) or old is None else value


def _check_value(value: Any, path: Path, name: str) -> None:
    """InputError for a value of the right type that no run could use."""
    if name in CHOICES and value not in CHOICES[name]:
        raise InputError(f"{path}: {name} must be one of {', '.join(CHOICES[name])}, not {value!r}")
    if not isinstance(value, str) and not 0 <= value < float("inf"):
        raise InputError(f"{path}: {name} must be a finite number, not negative; it is {value!r}")
    if name in AT_LEAST_ONE and value < 1:
        raise InputError(f"{path}: {name} must be at least 1, not {value!r}")
