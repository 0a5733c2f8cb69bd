# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d evaluate`: a run, or any trajectory, against its ground truth."""

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vitamin3d.commands.outliers import report_outliers
from vitamin3d.commands.process import prepare
from vitamin3d.errors import InputError

if TYPE_CHECKING:
    from vitamin3d.datasets import Dataset
    from vitamin3d.evaluation.finished_run import Run, Truth

LONGEST_OFFSET_S = 4e9
"""More than the time since 1970; beyond twice of it nanoseconds do not fit into 64 bits."""


class Format(str, Enum):
    """Formats of trajectory files."""

    tum = "tum"
    euroc = "euroc"
    kitti = "kitti"


class FrameOfTruth(str, Enum):
    """What a ground truth is of."""

    auto = "auto"
    camera = "camera"
    body = "body"


def evaluate(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run, or a trajectory file (TUM, EuRoC, KITTI).")],
    ground_truth: Annotated[
        Path | None, typer.Option("--ground-truth", "-g", help="Trajectory file, or the folder of the sequence, which may bring one.")
    ] = None,
    source: Annotated[Path | None, typer.Option(help="The sequence, where --ground-truth is a file: T_BS, frames, tracks.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Camera file, where the sequence brings none; may hold T_BS.")] = None,
    format: Annotated[Format | None, typer.Option(help="Of the ground-truth file; by default it is recognised.")] = None,
    times: Annotated[Path | None, typer.Option(help="KITTI's times.txt, where it is not beside the poses.")] = None,
    truth_frame: Annotated[FrameOfTruth, typer.Option(help="What the truth is of; auto: recognised, T_BS applied.")] = FrameOfTruth.auto,
    time_offset: Annotated[float, typer.Option(help="Seconds added to the times of the run.")] = 0.0,
    surface: Annotated[bool, typer.Option("--surface", help="Also score mesh and cloud against the sequence's depth maps.")] = False,
    reference: Annotated[
        Path | None, typer.Option(help="Score mesh and cloud against this scanner's cloud or mesh (EuRoC's data.ply).")
    ] = None,
    drop_outliers: Annotated[bool, typer.Option("--drop-outliers", help="Leave out points that are NaN or far from all others.")] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for JSON, table and plots; default: RUN/evaluation.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of the table.")] = False,
) -> None:
    """Score a trajectory: success rate, ATE, RPE, errors per axis and over time; names the frame and the alignment."""
    prepare()
    from vitamin3d.evaluation.evaluation_files import write_evaluation
    from vitamin3d.evaluation.evaluation_text import as_json, table
    from vitamin3d.evaluation.finished_run import TruthRequest, read_run, read_sequence, read_truth
    from vitamin3d.evaluation.reference_frame import TruthFrame
    from vitamin3d.evaluation.run_evaluation import evaluate as figures
    from vitamin3d.run_report import add_evaluation

    dataset = read_sequence(ground_truth, source, calibration)
    frame = None if truth_frame is FrameOfTruth.auto else TruthFrame(truth_frame.value)
    request = TruthRequest(ground_truth, source, calibration, format.value if format else None, times, frame)
    finished = read_run(run, times=times)
    truth = read_truth(request, dataset)
    offset_ns = _nanoseconds(time_offset)
    report = figures(finished, truth, dataset, offset_ns)
    if surface or reference is not None:
        report["surface"] = _surface(finished, truth, dataset, source or ground_truth, reference, drop_outliers)
    folder = out or (run / "evaluation" if run.is_dir() else None)
    typer.echo(as_json(report) if json else table(report), nl=not json)
    if folder is not None:
        written = write_evaluation(folder, report, finished, truth, offset_ns)
        if truth is not None:
            add_evaluation(run, finished, truth, report, offset_ns)
        if not json:
            typer.echo("\n" + "\n".join(f"  {path}" for path in written))


def _nanoseconds(offset_s: float) -> int:
    if not abs(offset_s) <= LONGEST_OFFSET_S:
        raise InputError(f"--time-offset {offset_s:g}: give seconds between -{LONGEST_OFFSET_S:g} and {LONGEST_OFFSET_S:g}")
    return round(offset_s * 1e9)


def _surface(
    run: "Run", truth: "Truth | None", dataset: "Dataset | None", folder: Path | None, reference: Path | None, drop_outliers: bool
) -> dict[str, Any]:
    from vitamin3d.evaluation.comparison import read_geometry_as, read_own
    from vitamin3d.evaluation.surface_report import surface_report

    if truth is None or dataset is None or folder is None:
        raise InputError(
            "a surface is scored in the world of the true trajectory; give the sequence's folder as --ground-truth or --source"
        )
    if not run.path.is_dir():
        raise InputError(f"{run.path}: a surface needs the folder of a finished run, not a trajectory alone")
    own, scan = read_own(run.path), None if reference is None else read_geometry_as("reference", reference)
    report_outliers([*own, *([scan] if scan else [])], drop_outliers)
    report = surface_report(run, own, truth, dataset, folder, scan)
    if report is None:
        raise InputError(f"{folder}: no depth maps (depth0/, depth.txt, frame-*.depth.png); give --reference with a true cloud or mesh")
    return report
