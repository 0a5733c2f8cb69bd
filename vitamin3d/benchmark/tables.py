# SPDX-License-Identifier: Apache-2.0
"""The paper's Tables 1 to 3 and Fig. 4 from the figures of all trials."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vitamin3d.benchmark.published import METHODS, TABLE_1, TABLE_2_MS, TABLE_3_MS, Published, euroc_name
from vitamin3d.exporters.line_plot import Axes, Line, line_plot

LEAST_SUCCESS = 0.90
"""Below this success rate a trial counts as failed, and its accuracy is given in brackets (Sec. 5.2)."""
PARTS = {
    "feature tracking, per frame": (("curvature_extrema", "flow", "track_extrema", "refill"), "frame"),
    "localisation and mapping, per frame": (("initialize", "localize", "map"), "frame"),
    "meshing and denoising, per keyframe": (("meshing", "denoising"), "each"),
    "TSDF and marching cubes, 15 cm, per time": (("fusion_low", "surface_low"), "each"),
    "TSDF and marching cubes, 2.5 cm, per time": (("keeping_views", "fusion_high", "surface_high"), "each"),
}
"""Row of Table 3 -> our steps, and what their time is divided by."""


@dataclass(frozen=True)
class Sequence:
    """All trials of a sequence, and what other systems made of the same pictures."""

    name: str
    trials: list[dict[str, Any]]
    peers: dict[str, dict[str, Any]] = field(default_factory=dict)
    """System -> success_rate, ate in metres, chronological."""


def summary(trials: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean and deviation (of the sample of trials, as numpy's std) of a sequence's figures; cm and percent."""
    ate = [100 * t["ate"]["Sim(3)"] for t in trials if "ate" in t and "Sim(3)" in t["ate"]]
    figures = {"cm": ate, "success": [100 * t["success_rate"] for t in trials], "retries": [float(t["retries"]) for t in trials]}
    means = {name: [float(np.mean(v)), float(np.std(v))] if v else None for name, v in figures.items()}
    return {"trials": len(trials), "is_success": bool(np.mean(figures["success"]) >= 100 * LEAST_SUCCESS) if trials else False, **means}


def table_1(sequences: list[Sequence]) -> str:
    """Success mark, cm, success rate and retries per sequence, ours, measured peers, and the paper's columns."""
    peers = sorted({name for sequence in sequences for name in sequence.peers})
    has_published = any(euroc_name(sequence.name) for sequence in sequences)
    heads = ["sequence (pictures)", "ours", *(f"{name} (measured)" for name in peers), *(METHODS if has_published else ())]
    rows = []
    for sequence in sequences:
        key, frames = euroc_name(sequence.name), sequence.trials[0]["frames"]
        row = [f"{sequence.name} ({frames})", _ours(sequence.trials), *(_peer(sequence.peers.get(name)) for name in peers)]
        rows.append(row + [_published(TABLE_1[key][m]) if key else "–" for m in METHODS if has_published])
    return _markdown(heads, rows)


def _ours(trials: list[dict[str, Any]]) -> str:
    found = summary(trials)
    cm = "–" if found["cm"] is None else f"{found['cm'][0]:.2f} ± {found['cm'][1]:.2f} cm"
    return _cell(found["is_success"], cm, found["success"], found["retries"])


def _peer(peer: dict[str, Any] | None) -> str:
    if peer is None:
        return "–"
    good, cm = peer["success_rate"] >= LEAST_SUCCESS, f"{100 * peer['ate']:.2f} cm"
    return f"{'✓' if good else '✗'} {cm if good else f'({cm})'}, {100 * peer['success_rate']:.1f} %"


def _published(cell: Published) -> str:
    return _cell(cell.success[0] >= 100 * LEAST_SUCCESS, f"{cell.cm[0]:.1f} ± {cell.cm[1]:.1f} cm", cell.success, cell.retries)


def _cell(good: bool, cm: str, success: tuple[float, float], retries: tuple[float, float] | None) -> str:
    again = "–" if retries is None else f"{retries[0]:.0f} ± {retries[1]:.0f}"
    return f"{'✓' if good else '✗'} {cm if good else f'({cm})'}, {success[0]:.1f} ± {success[1]:.1f} %, {again}"


def milliseconds(trials: list[dict[str, Any]]) -> dict[str, float]:
    """Rows of Table 3, mean over the trials; NaN where a step never ran."""
    return {row: float(np.mean([_per(t, *part) for t in trials])) if trials else float("nan") for row, part in PARTS.items()}


def _per(trial: dict[str, Any], names: tuple[str, ...], unit: str) -> float:
    steps: list[dict[str, float]] = [trial["steps"][name] for name in names if name in trial["steps"]]
    if not steps:
        return float("nan")
    if unit == "frame":
        return 1e3 * sum(step["total_seconds"] for step in steps) / max(1, int(trial["processed_frames"]))
    return sum(1e3 * step["total_seconds"] / max(1, step["count"]) for step in steps)


def table_2(sequences: list[Sequence]) -> str:
    """Tracking time per frame beside the paper's."""
    ours = milliseconds([t for s in sequences for t in s.trials])["feature tracking, per frame"]
    return _markdown(
        ["", "ours, here", *TABLE_2_MS], [["tracking, ms per frame", f"{ours:.1f}", *(f"{v:.0f}" for v in TABLE_2_MS.values())]]
    )


def table_3(sequences: list[Sequence]) -> str:
    """Times of the parts beside the paper's."""
    ours = milliseconds([t for s in sequences for t in s.trials])
    return _markdown(["ms", "ours, here", "VITAMIN-E (paper)"], [[row, f"{ours[row]:.1f}", f"{TABLE_3_MS[row]:.0f}"] for row in PARTS])


def figure_4(sequence: Sequence) -> str:
    """The error in time of all trials, and of other systems: SVG."""
    lines: list[Line] = []
    for trial in sequence.trials:
        if "chronological" in trial:
            seconds, error, _ = np.array(trial["chronological"]).T
            lines.append(Line("ours" if not lines else "", seconds, 100 * error, "#1f6feb"))
    for (name, peer), color in zip(sorted(sequence.peers.items()), ("#d1242f", "#9a6700", "#8250df", "#57606a"), strict=False):
        seconds, error = np.array(peer["chronological"]).T
        lines.append(Line(name, seconds, 100 * error, color, is_dashed=True))
    return line_plot(Axes(f"{sequence.name}: error after Sim(3)", "time [s]", "error [cm]", from_zero=True), lines)


def page(kind: str, sequences: list[Sequence], remark: str) -> str:
    """All tables as Markdown."""
    trials = sorted({len(s.trials) for s in sequences})
    count = f"{trials[0]}" if len(trials) == 1 else f"{trials[0]} to {trials[-1]}"
    parts = [
        f"# Benchmark: {kind}",
        f"{remark}. {count} trials per sequence, seeds from 0. RMSE of the camera after Sim(3); mean ± deviation over the trials.",
        "## Table 1: accuracy, localisation success rate, initialisation retries",
        table_1(sequences),
        "✗ and brackets: success rate below 90 %. Columns without `measured` are the paper's own figures.",
        "## Table 2: tracking time",
        table_2(sequences),
        "## Table 3: times of the parts",
        table_3(sequences),
        "The paper's on a Core i7-7820HQ; ours on this machine, its steps added up as they would run one after the other.",
        "## Fig. 4: errors in time",
        *(f"![{s.name}](fig4_{s.name}.svg)" for s in sequences),
    ]
    return "\n\n".join(parts) + "\n"


def _markdown(heads: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [heads, ["---"] * len(heads), *rows])
