# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d compare`: our run beside the clouds and meshes of other systems."""

import json as json_format
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vitamin3d.commands.outliers import report_outliers
from vitamin3d.commands.process import prepare

if TYPE_CHECKING:
    from vitamin3d.datasets import Dataset
    from vitamin3d.evaluation.comparison import Item
    from vitamin3d.evaluation.finished_run import Truth
    from vitamin3d.types import Array


def compare(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    others: Annotated[
        list[str], typer.Argument(help="Folders with a trajectory and a cloud, clouds or meshes (PLY, PCD, OBJ, txt), or CLOUD,TRAJECTORY.")
    ],
    ground_truth: Annotated[
        Path | None, typer.Option("--ground-truth", "-g", help="Trajectory, or the sequence's folder, whose depth maps are the truth.")
    ] = None,
    reference: Annotated[Path | None, typer.Option(help="True surface: a scanner's cloud or a mesh, in the ground truth's world.")] = None,
    source: Annotated[Path | None, typer.Option(help="The sequence, where --ground-truth is a file.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Camera file, where the sequence brings none.")] = None,
    keyframe: Annotated[int | None, typer.Option(help="Whose view is drawn; default: the one in the middle.")] = None,
    back: Annotated[float, typer.Option(help="The viewer steps back by so many median depths.")] = 0.3,
    up: Annotated[float, typer.Option(help="And up.")] = 0.2,
    right: Annotated[float, typer.Option(help="And to the right.")] = 0.0,
    drop_outliers: Annotated[bool, typer.Option("--drop-outliers", help="Leave out points that are NaN or far from all others.")] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for JSON, table and picture; default: RUN/comparison.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of the table.")] = False,
) -> None:
    """Compare with other systems: density, voxels, accuracy, completeness, coverage, and a picture side by side."""
    prepare()
    from vitamin3d.evaluation.comparison import compare as compared
    from vitamin3d.evaluation.comparison import read_geometry_as, read_other, read_own
    from vitamin3d.evaluation.comparison_text import markdown, picture
    from vitamin3d.evaluation.evaluation_files import make_folder
    from vitamin3d.evaluation.evaluation_text import without_nan
    from vitamin3d.evaluation.finished_run import TruthRequest, read_run, read_sequence, read_truth
    from vitamin3d.exporters.files import write_file
    from vitamin3d.exporters.rendering import jpeg

    finished, own, items = read_run(run), read_own(run), [read_other(spec) for spec in others]
    scan = None if reference is None else read_geometry_as("reference", reference)
    dataset = read_sequence(ground_truth, source, calibration)
    truth = read_truth(TruthRequest(ground_truth, source, calibration), dataset)
    report_outliers([*own, *items, *([scan] if scan else [])], drop_outliers)
    surface = _reference(scan, source or ground_truth, dataset, truth)
    report, placed = compared(own, items, truth, surface)
    is_metric = truth is not None or bool(finished.stats["scale"]["known"])
    report = {"run": str(run), "unit": "metre" if is_metric else "map unit", "ours": own[-1].name, **report}
    text, folder = markdown(report), out or run / "comparison"
    made: dict[str, bytes] = {
        "comparison.json": (json_format.dumps(without_nan(report), indent=1) + "\n").encode(),
        "comparison.md": text.encode(),
        "comparison.jpg": jpeg(picture(placed, run, {"right": right, "up": up, "back": back}, keyframe)),
    }
    make_folder(folder)
    for name, data in made.items():
        write_file(folder / name, [data])
    typer.echo(made["comparison.json"].decode() if json else text + "\n" + "\n".join(f"  {folder / name}" for name in made), nl=not json)


def _reference(scan: "Item | None", folder: Path | None, dataset: "Dataset | None", truth: "Truth | None") -> "Array | None":
    """Points of the true surface: of a file, or of the sequence's depth maps."""
    from vitamin3d.errors import InputError
    from vitamin3d.evaluation.reference_surface import cloud_of_depth, reference_points

    if scan is not None:
        if truth is None:
            raise InputError(f"{scan.path}: a true surface needs a ground truth of the trajectory in the same world; give --ground-truth")
        return reference_points(scan.geometry)
    camera: Any = None if dataset is None else dataset.ground_truth()
    if folder is None or dataset is None or camera is None:
        return None
    return cloud_of_depth(folder, dataset, camera)
