# SPDX-License-Identifier: Apache-2.0
"""One trial: a sequence reconstructed in a process of its own, scored, and remembered in a file that is whole or absent."""

import ctypes
import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.datasets import open_dataset
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.evaluation.evaluation_text import without_nan
from vitamin3d.evaluation.finished_run import TruthRequest, read_run, read_truth
from vitamin3d.evaluation.run_evaluation import evaluate
from vitamin3d.exporters.files import write_file
from vitamin3d.exporters.report import thinned_rows

NO_MAP, BAD_INPUT, BROKEN = 3, 2, 1
HEAVY = ("depth/*.png", "normals/*.png", "mesh_high.obj", "mesh_high.mtl", "mesh_low.ply", "tracks.npz")
"""Files of a trial that are removed once it is scored, but for its first one, unless all are to be kept."""
REMEMBERED = ("success_rate", "frames", "processed_frames", "keyframes", "cpu_seconds", "peak_memory_mb", "steps")
"""What of `stats.json`."""
CHRONOLOGY = 300
"""Moments of the errors in time that are remembered."""
DIE_WITH_PARENT = 1
"""Linux: PR_SET_PDEATHSIG."""
CHILD = "import sys; from vitamin3d.benchmark.trial import die_with_parent; die_with_parent(); from vitamin3d.cli import main; main()"


@dataclass(frozen=True)
class SequenceJob:
    """The trials of one sequence; plain values, so that it can travel to another process or machine."""

    name: str
    source: str
    folder: str
    """Where its trials go; the same for all machines."""
    trials: int
    options: tuple[str, ...] = ()
    """For `vitamin3d reconstruct`."""
    keep_all: bool = False


class TrialFailed(Vitamin3dError):
    """A trial ended as none may: killed, out of memory, or a defect; it may be tried again."""


def run_sequence(job: SequenceJob) -> list[dict[str, Any]]:
    """Runs the trials that are not finished yet; the figures of all.

    Raises:
        InputError: the sequence cannot be used.
        TrialFailed: a process was killed.
    """
    return [_finished(job, seed) or _run(job, seed) for seed in range(job.trials)]


def result_file(job: SequenceJob, seed: int) -> Path:
    """Where the figures of a trial are."""
    return Path(job.folder) / f"trial_{seed}.json"


def _finished(job: SequenceJob, seed: int) -> dict[str, Any] | None:
    """The figures of a trial that was finished earlier, with the same options."""
    try:
        found: dict[str, Any] = json.loads(result_file(job, seed).read_text())
    except (OSError, ValueError):
        return None
    return found if found.get("options") == list(job.options) and found.get("source") == job.source else None


def _run(job: SequenceJob, seed: int) -> dict[str, Any]:
    out, truth = Path(job.folder) / f"trial_{seed}", open_dataset(Path(job.source)).ground_truth()
    scale = ["--scale-from-ground-truth"] if truth is not None else []
    out.parent.mkdir(parents=True, exist_ok=True)
    arguments = ["reconstruct", job.source, "-o", str(out), "--seed", str(seed), "--overwrite", "--quiet", *scale, *job.options]
    begun = time.monotonic()
    done = subprocess.run([sys.executable, "-c", CHILD, *arguments], capture_output=True, text=True, check=False)
    last = (done.stderr.strip().splitlines() or [""])[-1].removeprefix("vitamin3d: ")
    if done.returncode == BAD_INPUT:
        raise InputError(f"{job.name}: {last}")
    if done.returncode not in (0, NO_MAP) and not _lacks_only_a_surface(done.returncode, out):
        raise TrialFailed(f"{job.name}, trial {seed}: the process ended with {done.returncode} {last}")
    seconds, stats = round(time.monotonic() - begun, 1), json.loads((out / "stats.json").read_text())
    result = {
        "sequence": job.name, "source": job.source, "options": list(job.options), "seed": seed, "seconds": seconds,
        "exit_code": done.returncode, "retries": stats["initialization_retries"], "points": stats["cloud_points"],
        **{name: stats[name] for name in REMEMBERED},
        **(_errors(job, out) if done.returncode != NO_MAP and truth is not None else {}),
    }  # fmt: skip
    if not job.keep_all:
        _lighten(out, HEAVY if seed == 0 else (*HEAVY, "mesh_high.ply", "report.html"))
    write_file(result_file(job, seed), [(json.dumps(without_nan(result)) + "\n").encode()])
    return result


def _lacks_only_a_surface(code: int, out: Path) -> bool:
    """No step broke, but no triangle came out: the trajectory is scored all the same."""
    path = out / "stats.json"
    stats = json.loads(path.read_text()) if code == BROKEN and path.is_file() else {}
    return bool(stats.get("empty_meshes")) and stats.get("failure") is None


def _errors(job: SequenceJob, out: Path) -> dict[str, Any]:
    """ATE of all alignments in metres, and the errors in time."""
    dataset = open_dataset(Path(job.source))
    truth = read_truth(TruthRequest(Path(job.source)), dataset)
    try:
        report = evaluate(read_run(out), truth, dataset)
    except InputError:  # too little was localised to be scored
        return {}
    series = report["chronological"]
    rows = thinned_rows(np.column_stack([series["seconds"], series["error"], series["running_rmse"]]), CHRONOLOGY)
    return {"ate": {name: errors["rmse"] for name, errors in report["ate"].items()}, "chronological": np.round(rows, 6).tolist()}


def _lighten(out: Path, names: Sequence[str]) -> None:
    for path in (path for name in names for path in out.glob(name)):
        path.unlink(missing_ok=True)


def die_with_parent() -> None:
    """This process is killed when the one that started it ends: nobody works on for a benchmark that was stopped."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DIE_WITH_PARENT, signal.SIGKILL)


def main(argv: Sequence[str]) -> int:
    """The process of one sequence: a job as JSON in, its trials finished; 2 for bad input, 1 for a trial that may be tried again."""
    die_with_parent()
    fields = json.loads(argv[0])
    try:
        run_sequence(SequenceJob(**{**fields, "options": tuple(fields["options"])}))
    except Vitamin3dError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT if isinstance(error, InputError) else 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
