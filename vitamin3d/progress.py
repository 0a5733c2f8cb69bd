# SPDX-License-Identifier: Apache-2.0
"""What the user sees of a run: a bar with an ETA on a terminal, plain lines elsewhere."""

import signal
import sys
import time
from types import FrameType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vitamin3d.atlas import Atlas
from vitamin3d.datasets.pictures import Unreadable
from vitamin3d.warmup import warm_up

SECONDS_BETWEEN_LINES = 5.0


class ConsoleObserver:
    """Shows progress, prints warnings, and turns Ctrl-C into an orderly stop. Use as a context."""

    def __init__(self, quiet: bool) -> None:
        self._console = Console(file=sys.stderr, highlight=False, soft_wrap=True)
        self._quiet, self._is_terminal = quiet, self._console.is_terminal and not quiet
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("frames"),
            TimeElapsedColumn(), TextColumn("ETA"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
            console=self._console, disable=not self._is_terminal,
        )  # fmt: skip
        self._tasks: dict[str, TaskID] = {}
        self._last_line = time.monotonic()
        self._started: dict[str, float] = {}
        self._stop = False

    def __enter__(self) -> "ConsoleObserver":
        self._handler = signal.signal(signal.SIGINT, self._interrupt)
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        signal.signal(signal.SIGINT, self._handler)

    def frame_done(self, done: int, total: int, atlas: Atlas) -> None:
        self._show("tracking and mapping", done, total, _course(atlas))

    def keyframe_done(self, done: int, total: int) -> None:
        self._show("reconstructing", done, total, "")

    def frame_skipped(self, reason: Unreadable) -> None:
        self.line(f"warning: {reason.path}: {reason.reason}; skipped")

    def should_stop(self) -> bool:
        return self._stop

    def line(self, text: str) -> None:
        """A line above the bar."""
        self._console.print(text, markup=False)

    def _show(self, step: str, done: int, total: int, note: str) -> None:
        if self._is_terminal:
            if step not in self._tasks:
                self._tasks[step] = self._progress.add_task(step, total=total, note=note)
            self._progress.update(self._tasks[step], completed=done, note=note)
        elif not self._quiet and (done == total or time.monotonic() - self._last_line > SECONDS_BETWEEN_LINES):
            self._last_line = time.monotonic()
            begun = self._started.setdefault(step, self._last_line)
            eta = (self._last_line - begun) / max(1, done) * (total - done)
            self.line(f"{step}: {done} of {total}, {note + ', ' if note else ''}{eta:.0f} s left")
        self._started.setdefault(step, time.monotonic())

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True
        self.line("stopping: what is reconstructed so far is being saved (Ctrl-C again: at once, nothing saved)")


def _course(atlas: Atlas) -> str:
    """State, maps and tracks; while the camera is lost in a map, what becomes of the next one comes after it."""
    slam, num_maps = atlas.current, len(atlas.ranked())
    counts = f"{slam.map.num_keyframes} keyframes, {len(slam.tracks)} tracks"
    if slam is not atlas.active:
        kept = f"{len(atlas.left) + 1} maps" if atlas.left else "the map"
        return f"{atlas.active.state.value}, {kept} kept; the next one: {slam.state.value}, {counts}"
    return f"{slam.state.value}, {f'{num_maps} maps, the newest with ' if num_maps > 1 else ''}{counts}"


def warmed_up() -> float:
    """Compiles or loads all kernels behind a bar (lines where there is no terminal); seconds that it took."""
    console, begun = Console(file=sys.stderr, highlight=False, soft_wrap=True), time.monotonic()
    columns = (TextColumn("compiling kernels"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None)

        def tell(done: int, total: int, name: str) -> None:
            progress.update(task, completed=done, total=total, description=name)
            if not console.is_terminal:
                console.print(f"compiling kernels: {done} of {total}, {name}", markup=False)

        warm_up(tell=tell)
    return time.monotonic() - begun
