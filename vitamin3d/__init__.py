# SPDX-License-Identifier: Apache-2.0
"""vitamin3d: from the pictures of one calibrated camera to a trajectory, a dense cloud and a mesh, on a CPU.

The public names are loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vitamin3d.atlas import Atlas
    from vitamin3d.bundle_adjustment.adjust import AdjustmentSettings, adjust
    from vitamin3d.bundle_adjustment.marginalization import marginalize
    from vitamin3d.bundle_adjustment.problem import make_problem
    from vitamin3d.bundle_adjustment.self_calibration import adjust_with_intrinsics
    from vitamin3d.config import Config, load_toml, paper_config
    from vitamin3d.datasets import Unreadable, open_dataset
    from vitamin3d.evaluation.comparison import compare, read_other, read_own
    from vitamin3d.evaluation.finished_run import TruthRequest, read_run, read_truth
    from vitamin3d.evaluation.run_evaluation import evaluate
    from vitamin3d.exporters.output_folder import OutputFolder
    from vitamin3d.geometry.cameras import Camera, PinholeCamera
    from vitamin3d.job import Job, Selection, reconstruct_sequence
    from vitamin3d.mapping.landmark_statistics import point_cloud
    from vitamin3d.reconstruction import Reconstruction
    from vitamin3d.runtime import SilentObserver, run_sequential, run_threaded
    from vitamin3d.scale import Scale
    from vitamin3d.slam import Slam
    from vitamin3d.slam_steps import SlamSteps
    from vitamin3d.tracking.front_end import FrontEnd
    from vitamin3d.tracking.tracker import Tracker
    from vitamin3d.types import Frame, SlamState, Surface, Trajectory

_HOMES = {
    "atlas": ("Atlas",),
    "bundle_adjustment.adjust": ("AdjustmentSettings", "adjust"),
    "bundle_adjustment.marginalization": ("marginalize",),
    "bundle_adjustment.problem": ("make_problem",),
    "bundle_adjustment.self_calibration": ("adjust_with_intrinsics",),
    "config": ("Config", "load_toml", "paper_config"),
    "datasets": ("Unreadable", "open_dataset"),
    "evaluation.comparison": ("compare", "read_other", "read_own"),
    "evaluation.finished_run": ("TruthRequest", "read_run", "read_truth"),
    "evaluation.run_evaluation": ("evaluate",),
    "exporters.output_folder": ("OutputFolder",),
    "geometry.cameras": ("Camera", "PinholeCamera"),
    "mapping.landmark_statistics": ("point_cloud",),
    "job": ("Job", "Selection", "reconstruct_sequence"),
    "reconstruction": ("Reconstruction",),
    "runtime": ("SilentObserver", "run_sequential", "run_threaded"),
    "scale": ("Scale",),
    "slam": ("Slam",),
    "slam_steps": ("SlamSteps",),
    "tracking.front_end": ("FrontEnd",),
    "tracking.tracker": ("Tracker",),
    "types": ("Frame", "SlamState", "Surface", "Trajectory"),
}
_MODULES = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "AdjustmentSettings",
    "Atlas",
    "Camera",
    "Config",
    "Frame",
    "FrontEnd",
    "Job",
    "OutputFolder",
    "PinholeCamera",
    "Reconstruction",
    "Scale",
    "Selection",
    "SilentObserver",
    "Slam",
    "SlamState",
    "SlamSteps",
    "Surface",
    "Tracker",
    "Trajectory",
    "TruthRequest",
    "Unreadable",
    "adjust",
    "adjust_with_intrinsics",
    "compare",
    "evaluate",
    "load_toml",
    "make_problem",
    "marginalize",
    "open_dataset",
    "paper_config",
    "point_cloud",
    "read_other",
    "read_own",
    "read_run",
    "read_truth",
    "reconstruct_sequence",
    "run_sequential",
    "run_threaded",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'vitamin3d' has no attribute {name!r}")
    return getattr(import_module(f"vitamin3d.{_MODULES[name]}"), name)
