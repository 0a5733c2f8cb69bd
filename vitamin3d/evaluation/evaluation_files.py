# SPDX-License-Identifier: Apache-2.0
"""The folder that `vitamin3d evaluate` writes: `evaluation.json`, `evaluation.txt` and plots."""

from pathlib import Path
from typing import Any

from vitamin3d.errors import OutputError
from vitamin3d.evaluation.evaluation_text import as_json, plots, table
from vitamin3d.evaluation.finished_run import Run, Truth
from vitamin3d.evaluation.run_evaluation import pair
from vitamin3d.exporters.files import write_file


def write_evaluation(folder: Path, report: dict[str, Any], run: Run, truth: Truth | None, offset_ns: int = 0) -> list[Path]:
    """Writes the report; the paths written.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    made = {"evaluation.json": as_json(report), "evaluation.txt": table(report) + "\n"}
    if truth is not None:
        made |= {f"{stem}.svg": svg for stem, svg in plots(report, pair(run, truth, offset_ns)).items()}
    make_folder(folder)
    for name, text in made.items():
        write_file(folder / name, [text.encode()])
    return [folder / name for name in made]


def make_folder(folder: Path) -> None:
    """The folder and those above it; OutputError where that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another with -o") from None
