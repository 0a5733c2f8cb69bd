# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one file that shows a run, offline: interactive 3D, pictures, plots, times, settings.

The 3D view is `report_viewer.js` beside this file, WebGL 2 without a library. A content security policy in the page forbids
every request. Places and colours are quantised (16 and 8 bits); a large mesh is decimated by clustering its vertices.
"""

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.types import Array, Surface

MAX_BYTES = 15_000_000
LOW_BITS = (1 << 21) - 1
"""Three numbers of a cell or a triangle share one integer."""
MAX_TRIANGLES, MAX_POINTS, MAX_POSITIONS = 160_000, 120_000, 4000
VIEWER = Path(__file__).with_name("report_viewer.js")
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
STYLE = """
body{margin:0 auto;max-width:1180px;padding:0 18px 40px;font:15px/1.5 system-ui,sans-serif;color:#1f2328;background:#fff}
h1{font-size:24px;margin:22px 0 4px}h2{font-size:18px;margin:30px 0 8px;border-bottom:1px solid #ddd}
.cards{display:flex;flex-wrap:wrap;gap:10px;margin:12px 0}.card{background:#f3f5f8;border-radius:8px;padding:8px 14px;min-width:96px}
.card b{display:block;font-size:19px}.card span{color:#57606a;font-size:12px}
#view{width:100%;height:560px;display:block;border:1px solid #d0d7de;border-radius:8px;touch-action:none;outline-offset:2px}
.controls{display:flex;flex-wrap:wrap;gap:6px 16px;align-items:center;margin:8px 0;font-size:13px}
.controls label{white-space:nowrap}#hint{color:#57606a;font-size:12px}
.strip{display:flex;flex-wrap:wrap;gap:10px}.strip figure{margin:0;width:370px;max-width:100%}.strip img{width:100%;border-radius:4px}
figcaption{font-size:12px;color:#57606a}table{border-collapse:collapse;font-size:13px}td,th{padding:3px 12px 3px 0;text-align:left}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}.bar{background:#1f6feb;height:9px;border-radius:2px}
pre{background:#f6f8fa;padding:12px;overflow:auto;font-size:12px}svg{max-width:100%;height:auto}.strip svg{width:560px}
"""


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    caption: str
    jpeg: bytes


@dataclass(frozen=True)
class Report:
    """What a report shows; lengths in the unit of the run's files."""

    title: str
    subtitle: str
    cards: Sequence[tuple[str, str]]
    """Figure and what it is."""
    T_world_cam: Array
    """(K, 4, 4) keyframes."""
    positions: Array
    """(T, 3) camera centres of all frames."""
    half_view: tuple[float, float]
    """Tangents of half the field of view, across and up."""
    surface: Surface | None = None
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    colors: Array = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    frames: Sequence[Picture] = ()
    normal_maps: Sequence[Picture] = ()
    plots: Sequence[str] = ()
    """SVG."""
    steps: dict[str, dict[str, float]] = field(default_factory=dict)
    """As in `stats.json`."""
    stats: str = ""
    settings: str = ""
    sections: Sequence[str] = ()
    """HTML, before the view: `section_table`, `section_text`."""


def report_html(report: Report) -> str:
    """The page, at most `MAX_BYTES` long: the mesh is made coarser until it fits."""
    triangles = MAX_TRIANGLES
    while True:
        page = _page(report, triangles)
        if len(page.encode()) <= MAX_BYTES or triangles < 1000:
            return page
        triangles //= 2


EVALUATION, TRUTH = (
    re.compile("(<!--evaluation-->).*?(<!--/evaluation-->)", re.DOTALL),
    re.compile('(<script id="truth"[^>]*>).*?(</script>)'),
)


def with_evaluation(page: str, section: str, truth: Array) -> str:
    """A page of `report_html` with the figures of an evaluation (HTML) and the true path (T, 3) in the run's world."""
    page = EVALUATION.sub(lambda found: found[1] + section + found[2], page)
    places = json.dumps(np.round(thinned_rows(truth, MAX_POSITIONS), 5).tolist())
    page = TRUTH.sub(lambda found: found[1] + places + found[2], page)
    return page.replace('<label class="truth" hidden>', '<label class="truth">')


def evaluation_section(table: str, plots: Sequence[str]) -> str:
    """The part of the page that an evaluation fills."""
    figures = f"<details open><summary>figures</summary><pre>{escape(table)}</pre></details>"
    return f"<h2>Against the ground truth</h2><div class=strip>{''.join(plots)}</div>{figures}"


def section_table(title: str, heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A part of the page: a table of plain text."""
    lines = [heads, *rows]
    cells = "".join(
        "<tr>" + "".join(f"<{kind}>{escape(str(cell))}</{kind}>" for cell in line) + "</tr>"
        for line, kind in zip(lines, ["th", *["td"] * len(rows)], strict=True)
    )
    return f"<h2>{escape(title)}</h2><table>{cells}</table>"


def section_text(title: str, text: str) -> str:
    """A part of the page: a paragraph of plain text."""
    return f"<h2>{escape(title)}</h2><p>{escape(text)}</p>"


def _page(report: Report, triangles: int) -> str:
    surface = None if report.surface is None or not len(report.surface.triangles) else decimated(report.surface, triangles)
    rows = np.linspace(0, len(report.points) - 1, min(MAX_POINTS, len(report.points))).astype(int)
    points, colors = report.points[rows], report.colors[rows]
    scene, data = _scene(report, surface, points, colors)
    parts = [
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="viewport" content="width=device-width,initial-scale=1"><link rel="icon" href="data:,">',
        f"<title>{escape(report.title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(report.title)}</h1><div>{escape(report.subtitle)}</div>",
        f"<div class=cards>{''.join(f'<div class=card><b>{escape(v)}</b><span>{escape(k)}</span></div>' for v, k in report.cards)}</div>",
        *report.sections,
        _view(report, surface, points),
        "<!--evaluation--><!--/evaluation-->",
        _strip("Tracked extrema", report.frames),
        _strip("Normal maps", report.normal_maps),
        f"<h2>Course of the run</h2><div class=strip>{''.join(report.plots)}</div>" if report.plots else "",
        _times(report.steps),
        f"<h2>Settings</h2><details><summary>config.toml</summary><pre>{escape(report.settings)}</pre></details>",
        f"<details><summary>stats.json</summary><pre>{escape(report.stats)}</pre></details>",
        *(f'<script id="{name}" type="application/octet-stream">{text}</script>' for name, text in data.items()),
        f'<script id="scene" type="application/json">{json.dumps(scene)}</script>',
        '<script id="truth" type="application/json">null</script>',
        f"<script>{VIEWER.read_text()}</script></body></html>\n",
    ]
    return "\n".join(parts)


def _view(report: Report, surface: Surface | None, points: Array) -> str:
    if surface is None and not len(points) and not len(report.positions):
        return "<p>There is no map: nothing to show in 3D.</p><canvas id=view hidden></canvas><span id=hint></span>" + _hidden_controls()
    boxes = {"mesh": surface is not None, "cloud": len(points) > 0, "trajectory": True, "keyframes": len(report.T_world_cam) > 0}
    checks = "".join(
        f'<label><input type=checkbox id="show-{name}"{" checked" if name != "cloud" or surface is None else ""}> {name}</label>'
        for name, is_there in boxes.items()
        if is_there
    )
    last = max(0, len(report.T_world_cam) - 1)
    count = f"{len(surface.triangles):,} of {len(report.surface.triangles):,} triangles, " if surface and report.surface else ""
    count += f"{len(points):,} of {len(report.points):,} points."
    return (
        '<h2>Map</h2><canvas id=view tabindex=0 aria-label="3D view of the map"></canvas><div class=controls>'
        f'{checks}<label class="truth" hidden><input type=checkbox id="show-truth" checked> ground truth</label>'
        "<label>shading <select id=shading><option value=0>colour</option><option value=1>clay</option><option value=2>normals</option>"
        "</select></label><label>points <input id=point-size type=range min=1 max=8 step=0.5 value=2></label>"
        f"<label>keyframe <input id=keyframe type=range min=0 max={last} value={last // 2}></label>"
        "<button id=home>reset view</button></div>"
        f"<div id=hint>{count} Drag: turn; shift or right button: move; wheel: zoom.</div>"
    )


def _hidden_controls() -> str:
    return "<span hidden><select id=shading></select><input id=point-size value=2><button id=home></button></span>"


def _scene(report: Report, surface: Surface | None, points: Array, colors: Array) -> tuple[dict[str, Any], dict[str, str]]:
    """What the viewer draws: JSON, and arrays in base64 by the id of their element."""
    data: dict[str, str] = {}
    mesh: dict[str, Any] | None = None
    cloud: dict[str, Any] | None = None
    if surface is not None:
        packed, low, extent = quantised(surface.vertices_world)
        data["mesh-data"] = _base64(packed.tobytes(), surface.colors.tobytes(), surface.triangles.astype("<u4").tobytes())
        mesh = {"vertices": len(packed), "low": low, "extent": extent}
    if len(points):
        packed, low, extent = quantised(points)
        data["cloud-data"] = _base64(packed.tobytes(), colors.tobytes())
        cloud = {"points": len(packed), "low": low, "extent": extent}
    eye, target, up, size = _first_view(report, points if len(points) else report.positions)
    scene = {
        "mesh": mesh,
        "cloud": cloud,
        "trajectory": np.round(thinned_rows(report.positions, MAX_POSITIONS), 5).tolist(),
        "keyframes": [_axes(T) for T in thinned_rows(report.T_world_cam, 600)],
        "frustum": {"size": round(0.025 * size, 6), "half": [round(v, 5) for v in report.half_view]},
        "up": up, "eye": eye, "target": target, "size": size,
    }  # fmt: skip
    return scene, data


def _axes(T_world_cam: Array) -> dict[str, list[float]]:
    columns = {"x": 0, "y": 1, "z": 2, "center": 3}
    return {name: np.round(T_world_cam[:3, k], 5).tolist() for name, k in columns.items()}


def _first_view(report: Report, points: Array) -> tuple[list[float], list[float], list[float], float]:
    """Eye, target, up and size of the scene: from behind the cameras at the middle of the map."""
    if len(points) == 0 or len(report.T_world_cam) == 0:
        return [0.0, 0.0, -3.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0], 1.0
    target = np.median(points, axis=0)
    size = float(np.percentile(np.linalg.norm(points - target, axis=1), 80)) or 1.0
    up = -report.T_world_cam[:, :3, 1].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.2 else -report.T_world_cam[0, :3, 1]
    back = report.T_world_cam[:, :3, 3].mean(axis=0) - target
    back -= (back @ up) * up
    back = back / np.linalg.norm(back) if np.linalg.norm(back) > 1e-3 * size else -report.T_world_cam[0, :3, 2]
    cameras = float(np.percentile(np.linalg.norm(report.T_world_cam[:, :3, 3] - target, axis=1), 90))
    distance = max(2.2 * size, 1.8 * cameras)
    eye = target + distance * (back + 0.35 * up)
    return eye.tolist(), target.tolist(), up.tolist(), size


def quantised(points: Array) -> tuple[Array, list[float], list[float]]:
    """Points (N, 3) as uint16 shares of their bounding box, and the box's low corner and extent."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = np.maximum(high - low, 1e-12)
    return np.rint((points - low) / extent * 65535).astype("<u2"), low.tolist(), extent.tolist()


def thinned_rows(rows: Array, most: int) -> Array:
    """At most so many of the rows, evenly spread, the first and the last among them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int))] if len(rows) else rows


def decimated(surface: Surface, most: int) -> Surface:
    """The mesh with at most so many triangles: vertices of one cell become their mean."""
    if len(surface.triangles) <= most:
        return surface
    a, b, c = (surface.vertices_world[surface.triangles[:, k]] for k in range(3))
    area = float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    cell = max(np.sqrt(2 * area / most), 1e-9)
    while True:
        group = _clusters(surface.vertices_world, cell)
        triangles = _grouped_triangles(surface.triangles, group)
        if len(triangles) <= most:
            return _clustered(surface, group, triangles)
        cell *= 1.15


def _clusters(points: Array, cell: float) -> Array:
    """(N,) number of the cell that each point lies in, without gaps."""
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    return np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_inverse=True)[1].reshape(-1)


def _grouped_triangles(triangles: Array, group: Array) -> Array:
    """The triangles (F, 3) between groups, each once, its lowest corner first."""
    p, q, r = group[triangles].T
    between = (p != q) & (q != r) & (r != p)
    p, q, r = p[between], q[between], r[between]
    lowest = [(r < p) & (r < q), (q < p) & (q < r)]
    p, q, r = (np.select(lowest, turned, as_is) for turned, as_is in (((r, q), p), ((p, r), q), ((q, p), r)))
    keys = np.unique((p << 42) | (q << 21) | r)
    return np.stack([keys >> 42, (keys >> 21) & LOW_BITS, keys & LOW_BITS], axis=1).astype(np.int32)


def _clustered(surface: Surface, group: Array, triangles: Array) -> Surface:
    """The triangles between the means of the groups' vertices."""
    counts = np.bincount(group)
    means = [
        np.stack([np.bincount(group, column[:, k].astype(np.float64)) / counts for k in range(3)], axis=1)
        for column in (surface.vertices_world, surface.normals_world, surface.colors)
    ]
    normals = means[1] / np.maximum(np.linalg.norm(means[1], axis=1, keepdims=True), 1e-12)
    return Surface(means[0], triangles, normals, np.rint(means[2]).astype(np.uint8))


def _base64(*parts: bytes) -> str:
    return base64.b64encode(b"".join(parts)).decode()


def _strip(title: str, pictures: Sequence[Picture]) -> str:
    return f"<h2>{title}</h2><div class=strip>{''.join(_figure(picture) for picture in pictures)}</div>" if pictures else ""


def _figure(picture: Picture) -> str:
    caption = escape(picture.caption)
    source = f"data:image/jpeg;base64,{_base64(picture.jpeg)}"
    return f'<figure><img alt="{caption}" src="{source}"><figcaption>{caption}</figcaption></figure>'


def _times(steps: dict[str, dict[str, float]]) -> str:
    if not steps:
        return ""
    longest = max(step["total_seconds"] for step in steps.values()) or 1.0
    rows = "".join(
        f"<tr><td>{escape(name.replace('_', ' '))}</td><td class=n>{step['count']}</td><td class=n>{step['median_ms']:.2f}</td>"
        f"<td class=n>{step['p95_ms']:.2f}</td><td class=n>{step['total_seconds']:.1f}</td>"
        f'<td style="width:200px"><div class=bar style="width:{100 * step["total_seconds"] / longest:.1f}%"></div></td></tr>'
        for name, step in steps.items()
    )
    heads = "<th>step</th><th class=n>times</th><th class=n>median ms</th><th class=n>95 % ms</th><th class=n>all s</th><th></th>"
    return f"<h2>Times</h2><table><tr>{heads}</tr>{rows}</table>"
