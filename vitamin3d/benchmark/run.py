# SPDX-License-Identifier: Apache-2.0
"""A whole benchmark: finds the sequences, runs what is not finished, writes tables and figures."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.benchmark.published import METHODS, TABLE_1, euroc_name
from vitamin3d.benchmark.schedule import Teller, run_jobs
from vitamin3d.benchmark.sequences import names_of, sequences_of
from vitamin3d.benchmark.tables import Sequence, figure_4, milliseconds, page, summary
from vitamin3d.benchmark.trial import CHRONOLOGY, SequenceJob, run_sequence
from vitamin3d.datasets import open_dataset
from vitamin3d.evaluation.comparison import TRAJECTORIES
from vitamin3d.evaluation.evaluation_files import make_folder
from vitamin3d.evaluation.evaluation_text import without_nan
from vitamin3d.evaluation.finished_run import Run, TruthRequest, read_run, read_truth
from vitamin3d.evaluation.run_evaluation import LEAST_MATCHES, SAME_FRAME_NS, evaluate
from vitamin3d.evaluation.trajectory_error import success_rate
from vitamin3d.exporters.files import write_file
from vitamin3d.exporters.report import thinned_rows
from vitamin3d.types import Trajectory


@dataclass(frozen=True)
class Plan:
    """What is to be run."""

    kind: str
    root: Path
    out: Path
    trials: int = 5
    options: tuple[str, ...] = ()
    """For `vitamin3d reconstruct`."""
    workers: int = 1
    scheduler: str | None = None
    peers: Path | None = None
    """Folder with `<system>/<sequence>/trajectory.tum` of other systems."""
    keep_all: bool = False
    only: tuple[str, ...] = ()
    """Names of the sequences to run; none: all."""


def run_benchmark(plan: Plan, tell: Teller) -> list[Path]:
    """Runs the plan; the paths of the tables and figures.

    Raises:
        InputError: no sequence is found.
        Vitamin3dError: sequences failed; those that did not are finished and remembered.
    """
    found = sequences_of(plan.kind, plan.root)
    pairs = [(name, path) for name, path in zip(names_of(found), found, strict=True) if not plan.only or name in plan.only]
    make_folder(plan.out)
    jobs = [_job(plan, name, path) for name, path in pairs]
    tell(f"{len(jobs)} sequences, {plan.trials} trials each: {', '.join(name for name, _ in pairs)}")
    run_jobs(jobs, plan.scheduler, plan.workers, tell)
    sequences = [Sequence(job.name, run_sequence(job), _peers(plan.peers, job)) for job in jobs]  # all finished: read, not run
    return _write(plan, sequences)


def _job(plan: Plan, name: str, path: Path) -> SequenceJob:
    return SequenceJob(name, str(path.resolve()), str((plan.out / name).resolve()), plan.trials, plan.options, plan.keep_all)


def _peers(folder: Path | None, job: SequenceJob) -> dict[str, dict[str, Any]]:
    """What other systems made of the same pictures, scored as ours; a system that localised hardly any of them is left out."""
    found = {}
    for system in sorted(folder.iterdir()) if folder is not None and folder.is_dir() else []:
        path = next((p for name in TRAJECTORIES if (p := system / job.name / name).is_file()), None)
        if path is not None:
            source = Path(job.source)
            dataset = open_dataset(source)
            times = dataset.timestamps_ns[: _max_frames(job.options)]
            run = _until(read_run(path), int(times[-1]))
            if len(run.estimate) < LEAST_MATCHES:
                continue
            report = evaluate(run, read_truth(TruthRequest(source), dataset), dataset)
            series = np.column_stack([report["chronological"]["seconds"], report["chronological"]["error"]])
            ate = report["ate"][report["alignment"]]["rmse"]
            found[system.name] = {
                "success_rate": success_rate(report["localised"], len(times)),
                "ate": ate,
                "chronological": thinned_rows(series, CHRONOLOGY).tolist(),
            }
    return found


def _max_frames(options: tuple[str, ...]) -> int | None:
    return int(options[options.index("--max-frames") + 1]) if "--max-frames" in options else None


def _until(run: Run, last_ns: int) -> Run:
    """The run without its poses after a moment."""
    kept = run.estimate.timestamps_ns <= last_ns + SAME_FRAME_NS
    return replace(run, estimate=Trajectory(run.estimate.timestamps_ns[kept], run.estimate.T_world_cam[kept]))


def _write(plan: Plan, sequences: list[Sequence]) -> list[Path]:
    options = f"`vitamin3d reconstruct` with {' '.join(plan.options)}" if plan.options else "`vitamin3d reconstruct`, default settings"
    made = {
        "tables.md": page(plan.kind, sequences, options),
        "benchmark.json": json.dumps(without_nan(_report(plan, sequences)), indent=1) + "\n",
    }
    made |= {f"fig4_{sequence.name}.svg": figure_4(sequence) for sequence in sequences}
    for name, text in made.items():
        write_file(plan.out / name, [text.encode()])
    return [plan.out / name for name in made]


def _report(plan: Plan, sequences: list[Sequence]) -> dict[str, Any]:
    rows = {}
    for sequence in sequences:
        key = euroc_name(sequence.name)
        rows[sequence.name] = {
            "ours": summary(sequence.trials),
            "milliseconds": milliseconds(sequence.trials),
            "peers": {name: {k: v for k, v in peer.items() if k != "chronological"} for name, peer in sequence.peers.items()},
            "published": {m: {"cm": TABLE_1[key][m].cm, "success": TABLE_1[key][m].success} for m in METHODS} if key else {},
        }
    return {"kind": plan.kind, "trials": plan.trials, "options": list(plan.options), "sequences": rows}
