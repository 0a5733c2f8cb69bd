# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d reconstruct` and `vitamin3d config`."""

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vitamin3d.commands.process import (
    EXIT_BROKEN,
    EXIT_INTERRUPTED,
    EXIT_NO_MAP,
    prepare,
)
from vitamin3d.errors import InputError

if TYPE_CHECKING:
    from vitamin3d.config import Config
    from vitamin3d.job import Job, Outcome


class Mode(str, Enum):
    """Named settings."""

    default = "default"
    paper = "paper"


class Refine(str, Enum):
    """When the calibration is refined."""

    auto = "auto"
    on = "on"
    off = "off"


def reconstruct(
    source: Annotated[Path, typer.Argument(help="EuRoC, TUM or KITTI folder, folder of pictures, or video.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")],
    calibration: Annotated[Path | None, typer.Option(help="Camera file with the fields of EuRoC's sensor.yaml.")] = None,
    refine_calibration: Annotated[
        Refine | None, typer.Option(help="Focal length and radial distortion: auto refines them where the motion determines them.")
    ] = None,
    mode: Annotated[Mode, typer.Option(help="default: what measures best; paper: the literal paper.")] = Mode.default,
    config: Annotated[Path | None, typer.Option(help="TOML file with settings that differ from the mode's.")] = None,
    threads: Annotated[bool, typer.Option("--threads/--sequential", help="Overlap the steps, or one after the other.")] = True,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the random samples.")] = None,
    start: Annotated[int, typer.Option(min=0, help="First frame.")] = 0,
    max_frames: Annotated[int | None, typer.Option(min=2, help="At most so many frames.")] = None,
    stride: Annotated[int, typer.Option(min=1, help="Every so many-th frame.")] = 1,
    voxel_low: Annotated[float | None, typer.Option(help="Coarse voxels, metres; needs a scale.")] = None,
    voxel_high: Annotated[float | None, typer.Option(help="Fine voxels, metres; needs a scale.")] = None,
    metric_scale: Annotated[float | None, typer.Option(help="Metres per map unit.")] = None,
    scale_from_ground_truth: Annotated[bool, typer.Option("--scale-from-ground-truth", help="Take the scale from it.")] = False,
    live: Annotated[bool, typer.Option("--live", help="Fuse while tracking; keyframes there is no time for are not meshed.")] = False,
    realtime: Annotated[bool, typer.Option("--realtime", help="--live, and pictures come when their time stamps say.")] = False,
    mesh: Annotated[bool, typer.Option("--mesh/--no-mesh", help="Meshes, depth and normal maps; or trajectory and cloud only.")] = True,
    save_tracks: Annotated[bool, typer.Option("--save-tracks", help="Also write tracks.npz.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Warnings and the result only.")] = False,
) -> None:
    """Reconstruct a sequence: trajectory, cloud, meshes, depth and normal maps."""
    prepare()
    from vitamin3d.job import Job, Selection

    voxels = _voxels(voxel_low, voxel_high, metric_scale, scale_from_ground_truth)
    job = Job(
        _settings(_named(mode, live or realtime), config, seed, refine_calibration, voxels),
        Selection(start, max_frames, stride),
        threads,
        metric_scale,
        scale_from_ground_truth,
        save_tracks,
        live or realtime,
        realtime,
        mesh,
    )
    try:
        code = _run(source, calibration, job, out, overwrite, quiet)
    except KeyboardInterrupt:  # caught here: Typer would end without a word
        typer.echo("vitamin3d: interrupted, nothing saved", err=True)
        code = EXIT_INTERRUPTED
    raise typer.Exit(code)


def show_config(
    mode: Annotated[Mode, typer.Option(help="Which named settings.")] = Mode.default,
    live: Annotated[bool, typer.Option("--live", help="As --live changes them.")] = False,
) -> None:
    """Print all settings as TOML, for --config."""
    from vitamin3d.config import dump_toml

    typer.echo(dump_toml(_named(mode, live)), nl=False)


def _named(mode: Mode, live: bool) -> "Config":
    from vitamin3d.config import Config, live_config, paper_config

    config = paper_config() if mode is Mode.paper else Config()
    return live_config(config) if live else config


def _voxels(low: float | None, high: float | None, metric_scale: float | None, from_truth: bool) -> dict[str, Any]:
    """The given voxel sizes in metres; InputError where they or the scale make no sense."""
    given = {name: value for name, value in (("voxel_low", low), ("voxel_high", high)) if value is not None}
    if metric_scale is not None and from_truth:
        raise InputError("--metric-scale and --scale-from-ground-truth exclude each other; give one")
    if given and metric_scale is None and not from_truth:
        raise InputError("--voxel-low and --voxel-high are in metres and need --metric-scale or --scale-from-ground-truth")
    for name, value in {**given, "metric_scale": metric_scale}.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise InputError(f"--{name.replace('_', '-')}: must be positive, not {value}")
    return given


def _settings(base: "Config", path: Path | None, seed: int | None, refine: Refine | None, voxels: dict[str, Any]) -> "Config":
    import dataclasses

    from vitamin3d.config import load_toml

    config = base if path is None else load_toml(path, base)
    config = config if seed is None else dataclasses.replace(config, seed=seed)
    if refine is not None:
        config = dataclasses.replace(config, calibration=dataclasses.replace(config.calibration, refine=refine.value))
    return dataclasses.replace(config, fusion=dataclasses.replace(config.fusion, **voxels))


def _run(source: Path, calibration: Path | None, job: "Job", out: Path, overwrite: bool, quiet: bool) -> int:
    """Opens, reconstructs, prints what came out; the exit code."""
    from vitamin3d._jit import kernels_are_cached
    from vitamin3d.datasets import open_dataset
    from vitamin3d.exporters.output_folder import OutputFolder
    from vitamin3d.job import reconstruct_sequence
    from vitamin3d.progress import ConsoleObserver, warmed_up

    dataset = open_dataset(source, calibration)
    job.selection.indices(len(dataset))
    output = OutputFolder(out, overwrite)
    for remark in [] if quiet else dataset.remarks:
        typer.echo(remark, err=True)
    if not kernels_are_cached():
        typer.echo("first run: the numerical kernels are being compiled, once; this takes about a minute", err=True)
        warmed_up()
    with ConsoleObserver(quiet) as observer:
        outcome = reconstruct_sequence(dataset, job, output, observer)
    return _conclude(outcome, out)


def _conclude(outcome: "Outcome", out: Path) -> int:
    stats = outcome.stats
    if not outcome.has_map:
        reason = stats["initialization_failure"]
        typer.echo(f"no map: {reason} (see {out / 'stats.json'})", err=True)
        return EXIT_INTERRUPTED if outcome.record.interrupted else EXIT_NO_MAP
    typer.echo(
        f"{stats['tracked_frames']} of {stats['frames']} frames localised{_in_maps(stats['maps'])}, {stats['keyframes']} keyframes, "
        f"{stats['cloud_points']} points, {stats['wall_seconds']:.0f} s; {outcome.scale.remark}"
    )
    if stats["live"]:
        typer.echo(_live_line(stats["live"]))
    if stats["calibration"]["refined"]:
        typer.echo(_calibration_line(stats["calibration"]["given"], stats["calibration"]["used"], out / "calibration.yaml"))
    for name in ("mesh_high.ply", "mesh_high.obj", "mesh_low.ply", "cloud.ply", "trajectory.tum"):
        if (out / name).exists():
            typer.echo(f"  {out / name}")
    for entry in stats["maps"][1:]:
        typer.echo(f"  {out / entry['folder']}: {entry['frames']} frames, {entry['keyframes']} keyframes, {entry['cloud_points']} points")
    _tell_gaps(outcome)
    if outcome.record.interrupted:
        return EXIT_INTERRUPTED
    return _say_empty_meshes(stats["empty_meshes"])


def _in_maps(maps: list[dict[str, Any]]) -> str:
    return f" in {len(maps)} maps (largest: {maps[0]['frames']})" if len(maps) > 1 else ""


def _tell_gaps(outcome: "Outcome") -> None:
    """Which frames are not localised, and why; where they are many, as a warning with what to do."""
    from vitamin3d.run_gaps import longest_told, warning

    stats, gaps = outcome.stats, outcome.gaps
    lines = [] if outcome.record.interrupted else warning(gaps, stats["tracked_frames"], stats["frames"], outcome.atlas.notes)
    if lines:
        typer.echo("\n  ".join([f"warning: {lines[0]}", *lines[1:]]), err=True)
    elif gaps:
        typer.echo("\n  ".join(["not localised:", *longest_told(gaps)]))


def _say_empty_meshes(names: list[str]) -> int:
    """A line about meshes without a triangle; the exit code, which is that of a broken step where the fine one is empty."""
    if names:
        remedy = "see surface.min_component_triangles and fusion.max_relative_deviation (`vitamin3d config`), or move the camera more"
        typer.echo(f"vitamin3d: no surface: {' and '.join(f'{n}.ply' for n in names)} would be empty, so not written; {remedy}", err=True)
    return EXIT_BROKEN if "mesh_high" in names else 0


def _calibration_line(given: dict[str, float], used: dict[str, float], path: Path) -> str:
    """What was refined of the camera."""
    changes = (("fx", "{:.1f}", 1.0, " px"), ("k1", "{:.4f}", 1.0, ""), ("readout_s", "{:.1f}", 1e3, " ms"))
    parts = [
        f"{name.removesuffix('_s')} {form.format(factor * given[name])} to {form.format(factor * used[name])}{unit}"
        for name, form, factor, unit in changes
        if used[name] != given[name]
    ]
    return f"calibration refined: {', '.join(parts)}; see {path}"


def _live_line(live: dict[str, Any]) -> str:
    """What a live run left out and what came late."""
    line = f"live: {live['keyframes_dropped']} of {live['keyframes_offered']} keyframes not meshed for lack of time"
    if "realtime" not in live:
        return line
    late, lag = live["realtime"], live["realtime"]["mesh_lag_seconds"]
    line += f"; {len(late['late_frames'])} frames late ({100 * late['late_share']:.1f} %), the worst {late['latency_ms']['worst']:.0f} ms"
    if lag:
        line += f"; the mesh began after {late['mesh_begins_seconds']:.1f} s"
        line += f", then {lag['median']:.1f} s behind the camera, at most {lag['worst']:.1f} s"
    return line
