# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d benchmark`: all sequences of a data set, several trials, the paper's tables."""

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from vitamin3d.commands.process import EXIT_INTERRUPTED, prepare
from vitamin3d.commands.reconstruct import Mode


class Kind(str, Enum):
    """Data sets."""

    euroc = "euroc"
    tum = "tum"
    icl = "icl"
    seven_scenes = "7scenes"
    kitti = "kitti"


def benchmark(
    kind: Annotated[Kind, typer.Argument(help="Which data set.")],
    root: Annotated[Path, typer.Argument(help="Folder that holds its sequences.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the trials, tables and figures; finished trials in it are kept.")],
    trials: Annotated[int, typer.Option(min=1, help="Per sequence, with seeds from 0.")] = 5,
    workers: Annotated[int, typer.Option(min=1, help="Sequences at a time on this machine.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a dask scheduler, or `local`; the folders must be shared.")] = None,
    mode: Annotated[Mode, typer.Option(help="default or paper, as in reconstruct.")] = Mode.default,
    config: Annotated[Path | None, typer.Option(help="TOML file with settings, as in reconstruct.")] = None,
    max_frames: Annotated[int | None, typer.Option(min=2, help="At most so many frames of each sequence.")] = None,
    only: Annotated[list[str] | None, typer.Option(help="Only this sequence; may be given again.")] = None,
    peers: Annotated[Path | None, typer.Option(help="Folder with SYSTEM/SEQUENCE/trajectory.tum of others, scored beside ours.")] = None,
    keep_all: Annotated[bool, typer.Option("--keep-all", help="Keep depth maps, normal maps and meshes of all trials.")] = False,
) -> None:
    """Run all sequences of a data set and print the paper's tables. Started again, it goes on where it was stopped."""
    prepare()
    from vitamin3d.benchmark.run import Plan, run_benchmark

    options: tuple[str, ...] = ("--mode", mode.value) if mode is not Mode.default else ()
    options += ("--config", str(config.resolve())) if config is not None else ()
    options += ("--max-frames", str(max_frames)) if max_frames is not None else ()
    plan = Plan(kind.value, root, out, trials, options, workers, scheduler, peers, keep_all, tuple(only or ()))
    try:
        written = run_benchmark(plan, lambda line: typer.echo(line, err=True))
    except KeyboardInterrupt:
        typer.echo("vitamin3d: interrupted; finished trials are kept, the same command goes on", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    typer.echo((out / "tables.md").read_text())
    typer.echo("\n".join(f"  {path}" for path in written))
