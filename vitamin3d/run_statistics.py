# SPDX-License-Identifier: Apache-2.0
"""What a run reports about itself: `stats.json`."""

import platform
import resource
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from vitamin3d.atlas import Atlas
from vitamin3d.exporters.output_folder import MAPS
from vitamin3d.geometry.cameras import Camera
from vitamin3d.map_output import MapOutput
from vitamin3d.mapping.calibration_refinement import CalibrationRefinement
from vitamin3d.runtime import RunRecord, median_of
from vitamin3d.scale import Scale
from vitamin3d.slam import Slam
from vitamin3d.types import Array, StepTimes

PACKAGES = ("vitamin3d", "numpy", "scipy", "numba", "opencv-python-headless", "open3d", "pymeshlab")


class Stopwatch:
    """Wall and CPU seconds since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def seconds(self) -> dict[str, float]:
        return {"wall_seconds": round(time.perf_counter() - self._wall, 3), "cpu_seconds": round(time.process_time() - self._cpu, 3)}


def step_table(*times: StepTimes) -> dict[str, dict[str, float]]:
    """Per step: how often it ran, median and 95th percentile in milliseconds, and all of it in seconds."""
    return {step: _summary(values) for t in times for step, values in t.milliseconds.items()}


def _summary(values: Sequence[float]) -> dict[str, float]:
    return {
        "count": len(values),
        "median_ms": round(float(np.median(values)), 3),
        "p95_ms": round(float(np.percentile(values, 95)), 3),
        "total_seconds": round(sum(values) / 1e3, 3),
    }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that make the result."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def calibration_table(camera: Camera, refinement: CalibrationRefinement) -> dict[str, Any]:
    """The camera that was given and the one that was used; each refinement with its standard deviations or why it was refused."""
    return {
        "refine": refinement.config.refine,
        "refined": camera != refinement.given,
        "given": _camera_table(refinement.given),
        "used": _camera_table(camera),
        "refinements": [
            {"keyframes": r.num_keyframes, "accepted": r.accepted, "reason": r.reason, "deviations": r.deviations} | _camera_table(r.camera)
            for r in refinement.history
        ],
    }


def _camera_table(camera: Camera) -> dict[str, float]:
    return {**camera.parameters, "readout_s": camera.readout_s}


LATE_MS = 50.0


def live_table(record: RunRecord, mesh_lags: list[float], mesh_begins: float | None = None) -> dict[str, Any]:
    """What a live run left out; and with a clock what came late.

    A frame's latency is the time from when its picture was due until its pose was there; it is late where that took longer
    than LATE_MS. A mesh's lag is the time until the keyframe's view was in the volume; the first views wait there for the choice of
    the voxels, and `mesh_begins` is the lag of the very first.
    """
    table: dict[str, Any] = {
        "keyframes_offered": record.keyframes_offered,
        "keyframes_dropped": record.keyframes_dropped,
        "adjustments_awaited": record.adjustments_awaited,
    }
    if record.latencies:
        milliseconds = np.array([1e3 * seconds for _, seconds in record.latencies])
        table["realtime"] = {
            "latency_ms": _spread(milliseconds),
            "late_frames": [[index, round(1e3 * seconds, 1)] for index, seconds in record.latencies if 1e3 * seconds > LATE_MS],
            "late_share": round(float((milliseconds > LATE_MS).mean()), 6),
            "mesh_begins_seconds": None if mesh_begins is None else round(mesh_begins, 3),
            "mesh_lag_seconds": _spread(np.array(mesh_lags)) if mesh_lags else None,
        }
    return table


def _spread(values: Array) -> dict[str, float]:
    return {name: round(float(np.percentile(values, share)), 3) for name, share in (("median", 50), ("p95", 95), ("worst", 100))}


def map_table(slam: Slam, rank: int, output: MapOutput) -> dict[str, Any]:
    """What there is of a map; the first is the largest. Its times are those of `trajectory.tum`."""
    stamps = slam.trajectory().timestamps_ns
    return {
        "number": rank,
        "folder": "." if rank == 1 else f"{MAPS}/{rank}",
        "birth": slam.number,
        "frames": len(slam.poses),
        "first_frame_s": float(stamps[0]) / 1e9 if len(stamps) else None,
        "last_frame_s": float(stamps[-1]) / 1e9 if len(stamps) else None,
        "keyframes": slam.map.num_keyframes,
        "landmarks": _num_landmarks(slam),
        "cloud_points": output.cloud_points,
        "voxels": output.voxels(),
        "empty_meshes": output.empty_meshes,
        "scale": _scale_table(output.scale),
    }


def _num_landmarks(slam: Slam) -> int:
    return len(slam.map.landmarks)


def _scale_table(scale: Scale) -> dict[str, Any]:
    return {"known": scale.is_known, "metres_per_map_unit": scale.metres_per_unit if scale.is_known else None, "source": scale.source}


def frame_table(record: RunRecord) -> dict[str, float | None]:
    """Median milliseconds of the frames in which the camera was tracked, and of the others; each with the median of the front end."""
    ahead = float(np.median(record.front_end_seconds)) if record.front_end_seconds else 0.0
    table: dict[str, float | None] = {}
    for name, is_tracked in (("tracked", True), ("not_localised", False)):
        seconds = [each for state, each in record.frame_seconds if state.is_tracked is is_tracked]
        table[name] = round(1e3 * (float(np.median(seconds)) + ahead), 3) if seconds else None
    return table


def num_localised(atlas: Atlas) -> int:
    """Frames that are localised in any of the maps."""
    return len({stamp for slam in atlas.ranked() for stamp in slam.trajectory().timestamps_ns.tolist()})


def run_statistics(atlas: Atlas, record: RunRecord, output: MapOutput, times: list[StepTimes], watch: Stopwatch) -> dict[str, Any]:
    """The report of a run as a JSON object; lengths in metres where the scale is known.

    Frames are those of all maps; keyframes, landmarks, points, calibration and scale are of the largest, whose output is given.
    """
    tracked, slam, scale = num_localised(atlas), largest_map(atlas), output.scale
    return {
        "frames": record.num_frames,
        "processed_frames": len(record.states),
        "unreadable_frames": len(record.skipped),
        "tracked_frames": tracked,
        "success_rate": round(tracked / max(1, record.num_frames), 6),
        "state": atlas.current.state.value,
        "interrupted": record.interrupted,
        "initialization_retries": slam.initializer.num_retries,
        "initialization_failure": slam.initializer.reason,
        "keyframes": slam.map.num_keyframes,
        "landmarks": _num_landmarks(slam),
        "cloud_points": output.cloud_points,
        "median_live_tracks": median_of(record.live_tracks),
        "frame_milliseconds": frame_table(record),
        "calibration": calibration_table(slam.camera, slam.mapper.calibration),
        "scale": _scale_table(scale),
        "unit": scale.unit if scale.is_known else "map unit (up to scale)",
        "steps": step_table(*times),
        **watch.seconds(),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "versions": versions(),
    }


def largest_map(atlas: Atlas) -> Slam:
    """The map with most frames; the one that is being begun where there is none."""
    return next(iter(atlas.ranked()), atlas.current)
