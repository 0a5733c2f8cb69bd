# SPDX-License-Identifier: Apache-2.0
"""A comparison as a table in Markdown and as a picture."""

from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.datasets.calibration import read_calibration
from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.evaluation.comparison import Placed
from vitamin3d.exporters.normal_map import NormalCaster
from vitamin3d.exporters.rendering import draw, draw_points, reduced, side_by_side, stepped_aside, viewer
from vitamin3d.geometry.cameras import Camera, PinholeCamera
from vitamin3d.geometry.se3 import inverse, transform_points
from vitamin3d.types import Array, Surface

DEFAULT_CAMERA = PinholeCamera(500.0, 500.0, 319.5, 239.5, 640, 480)
PANEL_WIDTH, SUPERSAMPLING = 420, 2
HOW = {"itself": "–", "trajectory": "trajectory", "registration": "shape", "none": "not found"}


def markdown(report: dict[str, Any]) -> str:
    """The table; lengths in centimetres where the unit is the metre."""
    has_truth = any("truth" in item for item in report["items"])
    unit = report["unit"]
    per = "m²" if unit == "metre" else "unit²"
    heads = ["what", "points", f"per {per}", "voxels 2 / 5 / 10 cm" if unit == "metre" else "voxels 0.02 / 0.05 / 0.1 unit", "placed by"]
    truth_heads = ["accuracy: median, within 5 cm", "completeness 5 / 10 cm", "chamfer", "RMSE: accuracy / completion / chamfer"]
    mutual_heads = ["median distance to ours / of ours to it"]
    heads += (truth_heads if has_truth else mutual_heads) + ["only ours covers", "only it covers"]
    rows = [
        [*_first_cells(item), *(_truth_cells(item) if has_truth else _mutual_cells(item, unit)), *_coverage(item)]
        for item in report["items"]
    ]
    lines = ["| " + " | ".join(cells) + " |" for cells in [heads, ["---"] * len(heads), *rows]]
    return "\n".join([*lines, "", *_notes(report, has_truth)]) + "\n"


def _first_cells(item: dict[str, Any]) -> list[str]:
    count = f"{item['points']:,}" + (f" ({item['triangles']:,} triangles)" if item["triangles"] else "")
    if "density" not in item:
        return [item["name"], count, "–", "–", HOW[item["placed_by"]]]
    found = item["density"]
    voxels = " / ".join(f"{number:,}" for number in found["voxels"].values())
    return [item["name"], count, f"{found['points_per_m2']:,.0f}", voxels, HOW[item["placed_by"]]]


def _truth_cells(item: dict[str, Any]) -> list[str]:
    if "truth" not in item:
        return ["–"] * 4
    t = item["truth"]
    return [
        f"{100 * t['accuracy_median']:.2f} cm, {t['accuracy_within_5cm']:.2f}",
        f"{t['completeness_5cm']:.2f} / {t['completeness_10cm']:.2f}",
        f"{100 * t['chamfer']:.1f} cm",
        f"{100 * t['rmse_accuracy']:.1f} / {100 * t['rmse_completion']:.1f} / {100 * t['rmse_chamfer']:.1f} cm",
    ]


def _mutual_cells(item: dict[str, Any], unit: str) -> list[str]:
    if "mutual" not in item:
        return ["–"]
    m = item["mutual"]
    factor, name = (100, "cm") if unit == "metre" else (1, "units")
    return [f"{factor * m['its_median']:.3g} / {factor * m['ours_median']:.3g} {name}"]


def _coverage(item: dict[str, Any]) -> list[str]:
    if "coverage" not in item:
        return ["–", "–"]
    return [f"{100 * item['coverage'][key]:.0f} %" for key in ("ours_only", "its_only")]


def _notes(report: dict[str, Any], has_truth: bool) -> list[str]:
    share = "the true surface (a point within 5 cm)" if has_truth else "all 10 cm voxels (0.1 units) that either occupies"
    lines = [
        f"Unit: {report['unit']}; world: {report['world']}. Coverage: shares of {share}. Ours for coverage and distances: {report['ours']}."
    ]
    outliers = [f"{item['name']}: {item['outliers']}" for item in report["items"] if item["outliers"]]
    lines += [f"Outlying points left out (not finite, or far from everything else): {', '.join(outliers)}."] if outliers else []
    lost = [f"{i['name']} (overlap {i['overlap']:.2f})" for i in report["items"] if i["placed_by"] == "none"]
    return lines + ([f"No registration was found for {', '.join(lost)}: neither its scale nor its frame is known."] if lost else [])


def picture(placed: list[Placed], run: Path, view: dict[str, float], keyframe: int | None = None) -> Array:
    """All items from one viewpoint, side by side: (H, W, 3) uint8 RGB.

    Args:
        run: folder of our run, whose keyframe the viewer starts from.
        view: `right`, `up` and `back`, in median depths of what the keyframe sees.
    """
    canvas_file = run / "depth" / "canvas.yaml"
    canvas = read_calibration(canvas_file).camera if canvas_file.is_file() else DEFAULT_CAMERA
    poses, ours = read_tum(run / "keyframes.tum").T_world_cam, placed[0].placement
    k = len(poses) // 2 if keyframe is None else min(max(0, keyframe), len(poses) - 1)
    T_world_cam = np.array(poses[k])
    T_world_cam[:3, :3] = ours.R @ T_world_cam[:3, :3]
    T_world_cam[:3, 3] = ours.apply(poses[k][None, :3, 3])[0]
    depth = _median_depth(
        placed[-1 if len(placed) == 1 else 1 if placed[1].item.geometry.is_mesh else 0].samples, canvas, inverse(T_world_cam)
    )
    T_view = stepped_aside(inverse(T_world_cam), depth, view["right"] * depth, view["up"] * depth, view["back"] * depth)
    camera = viewer(canvas, PANEL_WIDTH * SUPERSAMPLING)
    shown = [p for p in placed if p.placement.how != "none"]
    panels = [_panel(p, camera, T_view) for p in shown]
    return side_by_side(panels, [p.item.name for p in shown])


def _median_depth(points: Array, camera: Camera, T_cam_world: Array) -> float:
    cam = transform_points(T_cam_world, points)
    inside = camera.is_inside(np.nan_to_num(camera.ideal_from_points(cam), nan=-1.0))
    return float(np.median(cam[inside, 2])) if inside.any() else 1.0


def _panel(placed: Placed, camera: Camera, T_view: Array) -> Array:
    if placed.geometry.is_mesh:
        large = draw(NormalCaster(_surface(placed)), camera, T_view, "normals")
    else:
        large = draw_points(placed.geometry.points, None, camera, T_view, 1.0 * SUPERSAMPLING)
    return reduced(large, SUPERSAMPLING)


def _surface(placed: Placed) -> Surface:
    """The mesh with smooth vertex normals."""
    points, triangles = placed.geometry.points, placed.geometry.triangles
    a, b, c = (points[triangles[:, k]] for k in range(3))
    face, normals = np.cross(b - a, c - a), np.zeros_like(points)
    for k in range(3):
        np.add.at(normals, triangles[:, k], face)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    colors = placed.geometry.colors if placed.geometry.colors is not None else np.full(points.shape, 200, np.uint8)
    return Surface(points, triangles.astype(np.int32), normals, colors)
