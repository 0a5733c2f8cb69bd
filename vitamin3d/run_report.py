# SPDX-License-Identifier: Apache-2.0
"""Gathers what `report.html` shows: from the files of a finished run, its pictures, and the ground truth where there is one."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vitamin3d.atlas import Atlas
from vitamin3d.datasets.base import Dataset
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.datasets.tables import read_text
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import InputError
from vitamin3d.evaluation.evaluation_text import plots, table
from vitamin3d.evaluation.finished_run import Run, Truth, read_run
from vitamin3d.evaluation.reference_frame import TruthFrame
from vitamin3d.evaluation.run_evaluation import evaluate, pair
from vitamin3d.evaluation.trajectory_error import Alignment, alignment_between
from vitamin3d.exporters.files import write_file
from vitamin3d.exporters.line_plot import Axes, Line, line_plot
from vitamin3d.exporters.mesh import read_ply
from vitamin3d.exporters.rendering import jpeg
from vitamin3d.exporters.report import Picture, Report, evaluation_section, report_html, section_table, section_text, with_evaluation
from vitamin3d.geometry.rolling_shutter import measured_pixels
from vitamin3d.run_gaps import gap_rows
from vitamin3d.run_statistics import largest_map
from vitamin3d.runtime import RunRecord
from vitamin3d.slam import Slam
from vitamin3d.timestamps import seconds_from_nanoseconds
from vitamin3d.types import Array, Surface, Trajectory

NAME = "report.html"
NUM_PICTURES, PICTURE_WIDTH = 6, 720
MAPPED, WAITING = (60, 220, 90), (250, 190, 40)
"""Colours of extrema that are landmarks, and of those that are not yet."""
NO_TRAJECTORY = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))


def write_report(out: Path, dataset: Dataset, atlas: Atlas, record: RunRecord) -> None:
    """Writes `report.html` beside the other files of a run; it shows the largest map, and which frames no map has.

    Raises:
        OutputError: it cannot be written.
    """
    slam = largest_map(atlas)
    chosen = np.unique(np.linspace(0, max(0, slam.map.num_keyframes - 1), min(NUM_PICTURES, slam.map.num_keyframes)).astype(int))
    frames = [p for k in chosen if (p := _tracked_extrema(dataset, slam, int(k))) is not None]
    stamps = [seconds_from_nanoseconds(slam.map.timestamps_ns[k]) for k in chosen]
    course = [_live_tracks(record)] if record.live_tracks else []
    page = report_html(_report(out, dataset, frames, stamps, course))
    truth = read_truth_of(dataset)
    if truth is not None and (out / "trajectory.tum").is_file():
        page = _evaluated(page, read_run(out), truth, dataset)
    write_file(out / NAME, [page.encode()])


def add_evaluation(out: Path, run: Run, truth: Truth, report: dict[str, Any], offset_ns: int = 0) -> None:
    """Puts an evaluation into the report of a run that has one."""
    path = out / NAME
    if path.is_file():
        write_file(path, [_with_figures(read_text(path), run, truth, report, offset_ns).encode()])


def read_truth_of(dataset: Dataset) -> Truth | None:
    """The ground truth that a sequence brings, of the camera; None where it has none, or one that cannot be read."""
    try:
        own = dataset.ground_truth()
    except InputError:  # a run that does not need the truth does not fail by it
        return None
    return None if own is None else Truth(own, f"{dataset.name}'s own", TruthFrame.CAMERA)


def _evaluated(page: str, run: Run, truth: Truth, dataset: Dataset) -> str:
    """The page with its evaluation; as it was where too little of the run has a truth."""
    try:
        return _with_figures(page, run, truth, evaluate(run, truth, dataset), 0)
    except InputError:
        return page


def _with_figures(page: str, run: Run, truth: Truth, report: dict[str, Any], offset_ns: int) -> str:
    paired = pair(run, truth, offset_ns)
    s, R, t = alignment_between(paired.estimate, paired.truth, Alignment(report["alignment"]))
    path = (paired.truth.T_world_cam[:, :3, 3] - t) @ R / s
    return with_evaluation(page, evaluation_section(table(report), list(plots(report, paired).values())), path)


def _report(out: Path, dataset: Dataset, frames: list[Picture], stamps: list[str], course: list[str]) -> Report:
    stats = json.loads(read_text(out / "stats.json"))
    names = ("trajectory.tum", "keyframes.tum")
    trajectory, keyframes = (read_tum(out / name) if (out / name).is_file() else NO_TRAJECTORY for name in names)
    surface = read_ply(out / "mesh_high.ply") if (out / "mesh_high.ply").is_file() else None
    points, colors = _cloud(out / "cloud.ply")
    camera = dataset.camera
    return Report(
        f"{dataset.name}: {stats['tracked_frames']} of {stats['frames']} frames localised{_in_maps(stats['maps'])}",
        f"vitamin3d {stats['versions'].get('vitamin3d', '')}, mode {stats.get('mode', 'default')}; unit: {stats['unit']}",
        _cards(stats, surface),
        keyframes.T_world_cam,
        trajectory.T_world_cam[:, :3, 3],
        camera.half_field,
        surface,
        points,
        colors,
        frames,
        _normal_maps(out / "normals", stamps),
        course,
        stats["steps"],
        json.dumps(stats, indent=2),
        read_text(out / "config.toml") if (out / "config.toml").is_file() else "",
        _sections(stats),
    )


def _in_maps(maps: list[dict[str, Any]]) -> str:
    return f" in {len(maps)} maps, of which this is the largest" if len(maps) > 1 else ""


def _sections(stats: dict[str, Any]) -> list[str]:
    """What else there is to say: why there is no map, or which ones; the frames that none has."""
    sections = [] if stats["maps"] else [section_text("No map", stats["initialization_failure"])]
    sections += [_maps_section(stats["maps"], stats["first_frame_s"])] if len(stats["maps"]) > 1 else []
    if stats["not_localised"]:
        heads = ("frames", "what happened", "what to do")
        sections.append(section_table("Frames that are not localised", heads, gap_rows(stats["not_localised"])))
    return sections


def _maps_section(maps: list[dict[str, Any]], begin: float) -> str:
    """The maps of a run, the largest first; times count from the run's first frame."""
    heads = ("map", "folder", "frames", "from s", "to s", "keyframes", "points", "unit")
    rows = [
        (
            entry["number"],
            entry["folder"],
            f"{entry['frames']:,}",
            f"{entry['first_frame_s'] - begin:.2f}",
            f"{entry['last_frame_s'] - begin:.2f}",
            f"{entry['keyframes']:,}",
            f"{entry['cloud_points']:,}",
            "metre" if entry["scale"]["known"] else "its own",
        )
        for entry in maps
    ]
    return section_table("Maps", heads, rows)


def _cards(stats: dict[str, Any], surface: Surface | None) -> list[tuple[str, str]]:
    rate = stats["processed_frames"] / stats["wall_seconds"] if stats["wall_seconds"] else 0.0
    return [
        (f"{100 * stats['success_rate']:.1f} %", "frames localised"),
        (f"{len(stats['maps'])}", "maps" if len(stats["maps"]) != 1 else "map"),
        (f"{stats['keyframes']:,}", "keyframes"),
        (f"{stats['cloud_points']:,}", "points"),
        (f"{0 if surface is None else len(surface.triangles):,}", "triangles"),
        (f"{stats['median_live_tracks']:,.0f}", "tracks per frame"),
        (f"{stats['wall_seconds']:.0f} s", f"time, {rate:.1f} frames per second"),
        (f"{stats['peak_memory_mb']:,.0f} MB", "peak memory"),
        (f"{stats['initialization_retries']}", "initialisation retries"),
    ]


def _cloud(path: Path) -> tuple[Array, Array]:
    if not path.is_file():
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    try:
        found = read_geometry(path)
    except InputError:  # an empty cloud is no reason for no report
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return found.points, found.colors if found.colors is not None else np.full(found.points.shape, 90, np.uint8)


def _tracked_extrema(dataset: Dataset, slam: Slam, keyframe: int) -> Picture | None:
    """A keyframe's picture with its tracked extrema as dots; None where it cannot be read again."""
    frame = dataset.read(slam.map.frame_indices[keyframe])
    if isinstance(frame, Unreadable):
        return None
    rows = slam.map.observations_of(keyframe)
    pixels = measured_pixels(slam.map.obs_pixels[rows], slam.map.image_motions[keyframe], slam.camera)
    is_landmark = slam.map.is_mapped(slam.map.obs_landmark[rows])
    picture = np.repeat(frame.image[..., None], 3, axis=2) if frame.color is None else frame.color
    scale = PICTURE_WIDTH / picture.shape[1]
    drawn = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    for color, chosen in ((WAITING, ~is_landmark), (MAPPED, is_landmark)):
        for u, v in np.nan_to_num((pixels[chosen] + 0.5) * scale - 0.5, nan=-9.0):
            cv2.circle(drawn, (round(float(u)), round(float(v))), 2, color, -1, cv2.LINE_AA)
    caption = f"frame {frame.index}: {int(is_landmark.sum())} landmarks (green), {int((~is_landmark).sum())} extrema without depth (amber)"
    return Picture(caption, jpeg(np.asarray(drawn), 78))


def _normal_maps(folder: Path, stamps: list[str]) -> list[Picture]:
    """The normal maps nearest in time: not every keyframe has one."""
    pictures, there = [], sorted(folder.glob("*.png")) if folder.is_dir() else []
    for stamp in stamps if there else []:
        path = min(there, key=lambda p: abs(float(p.stem) - float(stamp)))
        pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR) if path.is_file() else None
        if pixels is not None:
            height = round(pixels.shape[0] * PICTURE_WIDTH / pixels.shape[1])
            small = cv2.resize(pixels, (PICTURE_WIDTH, height), interpolation=cv2.INTER_AREA)
            pictures.append(Picture(f"{path.stem} s", jpeg(np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)), 80)))
    return pictures


def _live_tracks(record: RunRecord) -> str:
    frames = np.arange(len(record.live_tracks))
    return line_plot(Axes("Live tracks", "frame", "tracks", from_zero=True), [Line("tracks", frames, np.array(record.live_tracks, float))])
