# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d figures`: the paper's Fig. 3 of a finished run as one picture."""

from pathlib import Path
from typing import Annotated

import typer

from vitamin3d.commands.process import prepare
from vitamin3d.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg")


def figures(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    others: Annotated[
        list[str] | None,
        typer.Argument(help="Clouds of other systems: folders with a trajectory and a cloud, clouds, or CLOUD,TRAJECTORY."),
    ] = None,
    source: Annotated[Path | None, typer.Option(help="The sequence: adds the tracked extrema, if the run has --save-tracks.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Camera file, where the sequence brings none.")] = None,
    keyframe: Annotated[int | None, typer.Option(min=0, help="Whose view is drawn; default: the one in the middle.")] = None,
    back: Annotated[float, typer.Option(help="The viewer steps back by so many median depths.")] = 0.3,
    up: Annotated[float, typer.Option(help="And up.")] = 0.2,
    right: Annotated[float, typer.Option(help="And to the right.")] = 0.0,
    width: Annotated[int, typer.Option(min=64, max=4000, help="Of each panel, pixels.")] = 480,
    without_picture: Annotated[bool, typer.Option("--without-picture", help="The extrema on black.")] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="PNG or JPEG file; default: RUN/figures.png.")] = None,
) -> None:
    """Draw a run as the paper's Fig. 3 does: tracked extrema, points, mesh, and normals at both voxel sizes."""
    prepare()
    from vitamin3d.evaluation.finished_run import read_sequence
    from vitamin3d.evaluation.paper_figure import Viewpoint, paper_figure
    from vitamin3d.exporters.depth_map import write_png
    from vitamin3d.exporters.files import write_file
    from vitamin3d.exporters.rendering import jpeg

    path = out or run / "figures.png"
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown ending; use {', '.join(SUFFIXES)}")
    viewpoint = Viewpoint(keyframe, right, up, back, width)
    page = paper_figure(run, others or [], read_sequence(None, source, calibration), viewpoint, not without_picture)
    if path.suffix.lower() == ".png":
        write_png(page, path)
    else:
        write_file(path, [jpeg(page)])
    typer.echo(f"  {path}")
