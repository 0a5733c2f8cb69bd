# SPDX-License-Identifier: Apache-2.0
"""All EuRoC sequences of a folder, several trials each: the paper's Table 1 on a page. Copy it and change what is scored.

    python pipelines/euroc_benchmark.py EUROC_FOLDER output 5

The command `vitamin3d benchmark` does more: a process per sequence, clusters, trials that need not be run again.
"""

import sys
from pathlib import Path

import numpy as np

from vitamin3d import Config, Job, OutputFolder, SilentObserver, TruthRequest, evaluate, open_dataset, read_run, read_truth
from vitamin3d import reconstruct_sequence as reconstruct


def trial(source: Path, out: Path, seed: int) -> tuple[float, float, int]:
    """Localisation success rate, ATE in cm (NaN without a map) and initialisation retries of one run."""
    dataset = open_dataset(source)
    outcome = reconstruct(dataset, Job(Config(seed=seed)), OutputFolder(out, overwrite=True), SilentObserver())
    if not outcome.has_map:
        return 0.0, float("nan"), outcome.stats["initialization_retries"]
    report = evaluate(read_run(out), read_truth(TruthRequest(source), dataset), dataset)
    return report["success_rate"], 100 * report["ate"]["Sim(3)"]["rmse"], report["retries"]


def main(argv: list[str] | None = None) -> int:
    """Runs the sequences below `argv[0]` into `argv[1]`, `argv[2]` times each (once by default); prints a row per sequence."""
    root, out, *count = sys.argv[1:] if argv is None else argv
    sequences = sorted(path.parents[2] for path in Path(root).glob("**/mav0/cam0/data.csv"))
    print("| sequence | ATE [cm] | success [%] | retries |\n| --- | --- | --- | --- |")
    for sequence in sequences:
        results = np.array([trial(sequence, Path(out) / sequence.name / str(k), k) for k in range(int(count[0]) if count else 1)])
        success, ate, retries = zip(results.mean(axis=0), results.std(axis=0), strict=True)
        mark = "✓" if success[0] >= 0.9 else "✗"  # below 90 % the paper calls it a failure
        row = f"| {sequence.name} | {mark} {ate[0]:.2f} ± {ate[1]:.2f} | {100 * success[0]:.1f} ± {100 * success[1]:.1f} |"
        print(f"{row} {retries[0]:.0f} ± {retries[1]:.0f} |", flush=True)
    return 0 if sequences else 2


if __name__ == "__main__":
    sys.exit(main())
