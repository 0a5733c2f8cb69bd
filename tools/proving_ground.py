# SPDX-License-Identifier: Apache-2.0
"""Runs the product on everything that breaks it, and prints one table: rendered recipes, real films, photo sets, cases from public reports.

    python tools/proving_ground.py --workers 2 --json new.json --against old.json    # everything but fisheye_room; renders what is lacking
    python tools/proving_ground.py office_pan office_pan@7 walk_loop cases           # @7: another room, walk and noise
    python tools/proving_ground.py recipes --ablate default --ablate "without anchors:window.anchors=0"
    python tools/proving_ground.py --list

Names: recipes, RECIPE@SEED, films, photo sets, earlier sequences, cases, or a group of them (recipes, films, earlier, photos, cases);
stray_picture_inside/KIND is one of its inputs alone. Everything that is read lies in the folder shared/ beside the repository, and what is
rendered in proving/ beside it. A row's figures are those of score.py: frames localised in any map, the same of the frames that show
something, how many maps, RMSE after a similarity per map, the largest over the smallest scale within a map, frames wrong by more than
20 times the median and 0.5 % of the path; then the median milliseconds of a frame that was localised and of one that was not. Photo
sets: error in percent of the extent instead of the path. stray_picture_inside: worst of the seeds, wrong frames of all of them, by its
check.py. false_start: of the 150 frames after the cut. "-": there is no such figure.
"""

import argparse
import ast
import dataclasses
import importlib.util
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.commands.process import ONE_THREAD_EACH
from vitamin3d.config import load_toml
from vitamin3d.errors import InputError, Vitamin3dError
from vitamin3d.exporters.files import write_file

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = (sys.executable, "-m", "vitamin3d.cli")
RECIPES, FILMS, EARLIER, PHOTOS, CASES = "recipes", "films", "earlier", "photos", "cases"
FOLDERS = {
    FILMS: ("office_plain", "walk_loop", "walk_oxford", "office_phone"),
    EARLIER: ("room1_v101_easy", "room1_v103_difficult", "kitchen", "kitti00", "euroc_v101_start"),
    PHOTOS: ("photos_lund", "photos_sceaux", "photos_monstree", "photos_drone"),
}
"""Of shared/data."""
FALSE_START, STRAY = "false_start", "stray_picture_inside"
LEFT_OUT = ("fisheye_room",)
"""Only where named."""
BY_COLMAP = ("walk_loop", "walk_oxford", "office_phone")
"""Whose truth has no metre."""
STRAY_KINDS, ALL_STRAY_KINDS = ("at5", "at10"), ("at5", "at10", "at15", "each20", "hand", "farview")
CASE_RATE_HZ, FALSE_FRAMES, DEMO_FRAMES = 20, 30, 150
FINISHED = "frames.csv"
"""Of a sequence that is rendered to its end."""
NAME = re.compile(r"(?P<base>[^@/]+)(@(?P<seed>\d+))?(/(?P<kind>\w+))?")

Row = dict[str, Any]


class NotMeasured(Vitamin3dError):
    """A sequence that could not be rendered, built or scored; its row says so."""


@dataclass(frozen=True)
class Target:
    """What a row of the table is about."""

    name: str
    """As it is printed, and that of its folders."""
    group: str
    base: str
    """Recipe, folder of shared/data, or case."""
    seed: int | None = None
    frames: int | None = None
    kind: str = ""
    """Of the case's inputs."""


@dataclass(frozen=True)
class Variant:
    """Settings under a name; values as TOML writes them."""

    name: str = "default"
    settings: tuple[tuple[str, str], ...] = ()

    def toml(self) -> str:
        return "".join(f"{key} = {value}\n" for key, value in self.settings)


@dataclass(frozen=True)
class Source:
    """A sequence that is ready to be run."""

    pictures: Path
    calibration: Path | None
    truth: Path
    """The folder that is scored against."""


# --- what there is ---------------------------------------------------------------------------------------------------


def catalogue(shared: Path) -> dict[str, tuple[str, ...]]:
    """All names, by group; InputError where the folder is not here."""
    if not (shared / "score" / "score.py").is_file():
        raise InputError(f"{shared}: no shared folder with score/score.py there; give --shared")
    names = {RECIPES: tuple(sorted(path.stem for path in (shared / "proving" / "recipes").glob("*.toml")))}
    names |= {group: tuple(name for name in all_ if (shared / "data" / name).is_dir()) for group, all_ in FOLDERS.items()}
    return names | {CASES: tuple(name for name in (FALSE_START, STRAY) if (shared / "cases" / name).is_dir())}


def selected(words: Sequence[str], names: dict[str, tuple[str, ...]], frames: int | None = None) -> list[Target]:
    """The targets that the words of the command line mean, in their order, each once; InputError for one that means nothing."""
    groups = {group: tuple(name for name in members if name not in LEFT_OUT) for group, members in names.items()}
    named = [name for word in words or groups for name in groups.get(word, (word,))]
    return list(dict.fromkeys(target for name in named for target in targets(name, names, frames)))


def targets(name: str, names: dict[str, tuple[str, ...]], frames: int | None) -> list[Target]:
    """Those of one name: one, but for a case of several inputs."""
    parts = NAME.fullmatch(name)
    base, kind = (parts["base"], parts["kind"] or "") if parts else ("", "")
    group = next((group for group, members in names.items() if base in members), None)
    if parts is None or group is None:
        raise InputError(f"{name}: no such recipe, film, photo set or case here; --list names them")
    if parts["seed"] and group != RECIPES:
        raise InputError(f"{name}: only recipes have seeds, and {base} is none")
    if kind and (base != STRAY or kind not in ALL_STRAY_KINDS):
        raise InputError(f"{name}: only {STRAY} has kinds, {', '.join(ALL_STRAY_KINDS)}")
    if base == STRAY:
        return [Target(f"{base}/{k}", group, base, kind=k) for k in ([kind] if kind else STRAY_KINDS)]
    if group != RECIPES:
        return [Target(name, group, base)]
    seed = int(parts["seed"]) if parts["seed"] else None
    whole = base if seed is None else f"{base}@{seed}"
    return [Target(whole if frames is None else f"{whole}_{frames}", group, base, seed, frames)]


def listing(names: dict[str, tuple[str, ...]], ground: Path) -> str:
    """A line for each name; of recipes also whether they are rendered, with other seeds and lengths that are."""
    lines = []
    for group, members in names.items():
        for name in members:
            ours = re.compile(rf"{re.escape(name)}(@\d+)?(_\d+)?")
            there = [path.name for path in sorted(ground.glob(f"{name}*")) if ours.fullmatch(path.name) and is_rendered(path)]
            note = (f"  rendered: {', '.join(there)}" if there else "  not rendered") if group == RECIPES else ""
            lines.append(f"{group:9}{name:24}{note}".rstrip())
    return "\n".join(lines)


# --- settings --------------------------------------------------------------------------------------------------------


def setting(text: str) -> tuple[str, str]:
    """`section.key=value` as key and TOML value; words are strings."""
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not re.fullmatch(r"\w+(\.\w+)*", key) or not value:
        raise InputError(f"{text}: not of the form section.key=value")
    try:
        tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return key, json.dumps(value)
    return key, value


def variants(sets: Sequence[str], ablations: Sequence[str]) -> list[Variant]:
    """The settings of each table; InputError for one that the product would refuse."""
    common = dict(setting(text) for text in sets)
    found = []
    for ablation in ablations or ("default",):
        name, _, changes = ablation.partition(":")
        own = dict(setting(text) for text in changes.split(",")) if changes else {}
        found.append(Variant(name.strip(), tuple((common | own).items())))
    if len({variant.name for variant in found}) < len(found) or not all(re.fullmatch(r"[\w .+-]*\w[\w .+-]*", v.name) for v in found):
        raise InputError("--ablate: each needs a name of its own, of letters, digits, spaces, '.', '+' and '-'")
    with tempfile.TemporaryDirectory() as folder:
        for variant in found:
            path = Path(folder) / f"{variant.name}.toml"
            path.write_text(variant.toml())
            try:
                load_toml(path)
            except InputError as error:
                raise InputError(str(error).replace(f"{path}: ", f"{variant.name}: ")) from None
    return found


# --- rendering -------------------------------------------------------------------------------------------------------


def is_rendered(folder: Path) -> bool:
    """Whether it was rendered to the end."""
    return (folder / FINISHED).is_file()


def seeded_recipe(text: str, seed: int, folder: Path) -> str:
    """The recipe of another place, walk and noise; its `plugin` is looked for in the folder."""
    values = tomllib.loads(text)
    values["seed"] = seed
    scene = values.setdefault("scene", {})
    scene["seed"] = scene.get("seed", 0) + seed
    if values.get("plugin"):
        values["plugin"] = str((folder / values["plugin"]).resolve())
    return "".join(f"{key} = {_toml_value(value)}\n" for key, value in values.items())


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_toml_value(v)}' for key, v in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml_value, value))}]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, (str, bool)) else repr(value)


def render(target: Target, shared: Path, ground: Path, threads: int) -> Path:
    """The rendered sequence, from the cache or made now: beside it and renamed, so that a half-rendered one is never used."""
    place = ground / target.name
    if is_rendered(place):
        return place
    recipe = shared / "proving" / "recipes" / f"{target.base}.toml"
    if target.seed is not None:
        copy = ground / "recipes" / f"{target.base}@{target.seed}.toml"
        copy.parent.mkdir(parents=True, exist_ok=True)
        write_file(copy, [seeded_recipe(recipe.read_text(), target.seed, recipe.parent).encode()])
        recipe = copy
    ground.mkdir(parents=True, exist_ok=True)
    half = ground / f"rendering_{target.name}.{os.getpid()}"
    shutil.rmtree(half, ignore_errors=True)
    length = [] if target.frames is None else ["--frames", str(target.frames)]
    command = [sys.executable, str(shared / "proving" / "make_sequence.py"), str(recipe), "-o", str(half), *length]
    counts = dict.fromkeys((*ONE_THREAD_EACH, "NUMBA_NUM_THREADS"), str(threads))
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | counts, check=False)
        if done.returncode or not is_rendered(half):
            raise NotMeasured(f"not rendered: {last_line(done.stderr) or f'ended with {done.returncode}'}")
        _put(half, place)
    finally:
        shutil.rmtree(half, ignore_errors=True)
    return place


def _put(half: Path, place: Path) -> None:
    """What somebody else finished meanwhile stays; what was left half rendered goes."""
    if is_rendered(place):
        return
    if place.is_dir() and {path.name for path in place.iterdir()} <= {path.name for path in half.iterdir()}:
        shutil.rmtree(place)
    if place.exists():
        raise NotMeasured(f"not rendered: {place} is in the way and holds other things; move it")
    half.rename(place)


# --- running ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ProvingGround:
    """Where everything is, and how it is run."""

    shared: Path
    ground: Path
    work: Path
    """Inputs that are built, settings and results."""
    score: Any
    """The module score.py."""
    options: tuple[str, ...] = ("--sequential", "--no-mesh", "--quiet", "--overwrite")
    case_seeds: int = 5
    render_threads: int = 1
    timeout_s: float = 3600.0
    keep: bool = True
    """The results of runs."""

    def measure(self, variant: Variant, target: Target) -> Row:
        """A row's figures; with `problem` where something failed."""
        try:
            source = self.prepared(target)
            seeds = range(self.case_seeds) if target.base == STRAY else (None,)
            return combined([self._run(target, variant, source, seed) for seed in seeds])
        except Vitamin3dError as error:
            return {"exit_code": None, "problem": str(error)}

    def prepared(self, target: Target) -> Source:
        """The target's sequence, rendered or built where it is lacking."""
        if target.group == RECIPES:
            folder = render(target, self.shared, self.ground, self.render_threads)
            return Source(folder, None, folder)
        if target.group == CASES:
            return self._case(target)
        folder = self.shared / "data" / target.base
        if target.group == PHOTOS:
            return Source(folder / "images", folder / "camera.yaml", folder)
        video = folder / "video.mp4"
        return Source(video, folder / "camera.yaml", folder) if video.is_file() else Source(folder, None, folder)

    def _case(self, target: Target) -> Source:
        folder = self.work / "inputs" / file_name(target.name)
        if not folder.is_dir():
            half = folder.with_name(f"{folder.name}.half")
            shutil.rmtree(half, ignore_errors=True)
            half.mkdir(parents=True)
            done = self._script(self.shared / "cases" / target.base / "make.py", half)
            if done.returncode:
                raise NotMeasured(f"not built: {last_line(done.stderr)}")
            if target.base == FALSE_START:
                add_demo_truth(half)
            half.rename(folder)
        return Source(folder / (target.kind or "cut"), folder / "c.yaml", folder)

    def _script(self, script: Path, *arguments: object) -> "subprocess.CompletedProcess[str]":
        """One of the shared scripts, run to its end."""
        paths = {"DEMO": str(ROOT / "data" / "demo"), "PYTHONPATH": str(self.shared / "cases"), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, str(script), *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, env=os.environ | paths, check=False)

    def _run(self, target: Target, variant: Variant, source: Source, seed: int | None) -> Row:
        out = self.work / file_name(variant.name) / (file_name(target.name) + ("" if seed is None else f"_seed_{seed}"))
        shutil.rmtree(out, ignore_errors=True)  # nothing that an earlier run left is scored
        out.parent.mkdir(parents=True, exist_ok=True)
        more = [] if source.calibration is None else ["--calibration", str(source.calibration)]
        more += [] if seed is None else ["--seed", str(seed)]
        if variant.settings:
            config = out.with_suffix(".toml")
            write_file(config, [variant.toml().encode()])
            more += ["--config", str(config)]
        row = executed([*PRODUCT, "reconstruct", str(source.pictures), "-o", str(out), *self.options, *more], self.timeout_s) | costs(out)
        try:
            row |= self._scored(target, source, out)
        except (ArithmeticError, LookupError, OSError, SyntaxError, ValueError) as error:
            row.setdefault("problem", f"not scored: {last_line(str(error)) or type(error).__name__}")
        if "problem" in row:
            row["problem"] = row["problem"].replace(str(out), "OUT")
        if not self.keep:
            shutil.rmtree(out, ignore_errors=True)
        return row if seed is None else {"seed": seed, **row}

    def _scored(self, target: Target, source: Source, out: Path) -> Row:
        if target.group == PHOTOS:
            return self._photos(source, out)
        if target.base == STRAY:
            return self._strays(target.kind, out)
        row: Row = self.score.maps(source.truth, out)
        if target.base == FALSE_START:
            row["success_rate"] = sum(k >= FALSE_FRAMES for k in frames_of(self.score, out)) / DEMO_FRAMES
        elif target.base not in BY_COLMAP and "ate_percent_of_path" in row:
            row["ate_cm"] = row["ate_percent_of_path"] * row["path_m"]
        return row

    def _photos(self, source: Source, out: Path) -> Row:
        pictures = len(list(source.pictures.iterdir()))
        if not (out / "trajectory.tum").is_file():
            return {"maps": 0, "placed": 0, "pictures": pictures, "success_rate": 0.0}
        done = self._script(self.shared / "score" / "photos.py", source.truth, out)
        if done.returncode:
            raise ValueError(last_line(done.stderr))
        found: Row = json.loads(done.stdout.splitlines()[-1])
        shares = {new: found[old] for new, old in (("ate_percent_of_path", "rmse_percent"), ("max_percent", "max_percent")) if old in found}
        return {"maps": len(map_folders(out)), "placed": found["placed"], "pictures": pictures, **shares} | {
            "success_rate": found["placed"] / pictures
        }

    def _strays(self, kind: str, out: Path) -> Row:
        """By check.py, each map on its own: a wrong pose, or a stray picture that has one, is a wrong frame."""
        folders, localised, wrong = map_folders(out), set[int](), list[Any]()
        for folder in folders:
            done = self._script(self.shared / "cases" / STRAY / "check.py", kind, folder)
            told = re.search(r"wrong \(frame, cm, deg\): (\[.*\])", done.stdout)
            if told is None:
                raise ValueError(last_line(done.stderr))
            wrong += ast.literal_eval(told[1])
        localised.update(frames_of(self.score, out) - {k for k, *how in wrong if len(how) == 1})
        frames = DEMO_FRAMES if kind == "each20" else 100
        return {"maps": len(folders), "success_rate": len(localised) / frames, "wrong_frames": len(wrong), "wrong": wrong}


def add_demo_truth(folder: Path) -> None:
    """What false_start is scored against: the demo's poses, begun after the frames of something else."""
    demo, truth = ROOT / "data" / "demo" / "mav0", Path("state_groundtruth_estimate0") / "data.csv"
    rows = [line.split(",") for line in (demo / truth).read_text().splitlines() if line.strip() and not line.startswith("#")]
    start = min(int(path.stem) for path in (demo / "cam0" / "data").iterdir()) - FALSE_FRAMES * 10**9 // CASE_RATE_HZ
    for name in ("cam0", truth.parent):
        (folder / "mav0" / name).mkdir(parents=True)
    shutil.copy(demo / "cam0" / "sensor.yaml", folder / "mav0" / "cam0")
    (folder / "mav0" / truth).write_text("".join(f"{int(t) - start},{','.join(pose)}\n" for t, *pose in rows))
    (folder / "rgb").symlink_to("cut")  # where score.py counts the frames


def executed(command: list[str], timeout_s: float) -> Row:
    """The product's exit code, its seconds, and its last words where it complains."""
    begun, one = time.monotonic(), dict.fromkeys((*ONE_THREAD_EACH, "NUMBA_NUM_THREADS"), "1")
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | one, cwd=ROOT, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return {"exit_code": None, "seconds": timeout_s, "problem": f"stopped after {timeout_s:.0f} s"}
    row: Row = {"exit_code": done.returncode, "seconds": round(time.monotonic() - begun, 1)}
    return row | ({"problem": last_line(done.stderr)} if done.returncode else {})


def costs(out: Path) -> Row:
    """What stats.json says of time and memory."""
    try:
        stats = json.loads((out / "stats.json").read_text())
    except (OSError, ValueError):
        return {}
    each = stats.get("frame_milliseconds") or {}
    row = {"tracked_ms": each.get("tracked"), "not_localised_ms": each.get("not_localised")}
    return row | {name: stats.get(name) for name in ("cpu_seconds", "peak_memory_mb")}


def map_folders(out: Path) -> list[Path]:
    """Of all maps of a run, the largest first."""
    return [path.parent for path in (out / "trajectory.tum", *sorted(out.glob("maps/*/trajectory.tum"))) if path.is_file()]


def frames_of(score: Any, out: Path) -> set[int]:
    """The frames of a case that are localised in any map."""
    return {round(CASE_RATE_HZ * t) for folder in map_folders(out) for t in score.read_tum(folder / "trajectory.tum")[0]}


def combined(rows: list[Row]) -> Row:
    """One row of several runs: the worst, the wrong frames of all, the median of times."""
    if len(rows) == 1:
        return rows[0]
    ways: dict[str, Callable[[list[Any]], Any]] = {
        "success_rate": min, "maps": max, "wrong_frames": sum, "tracked_ms": np.median, "not_localised_ms": np.median,
        "cpu_seconds": np.median, "peak_memory_mb": max, "exit_code": lambda codes: max(codes, key=abs),
    }  # fmt: skip
    found: Row = {}
    for key, way in ways.items():
        values = [row[key] for row in rows if row.get(key) is not None]
        complete = len(values) == len(rows) or key in ("tracked_ms", "not_localised_ms")
        found[key] = way(values) if values and complete else None
    found = {key: float(value) if isinstance(value, np.floating) else value for key, value in found.items()}
    problems = [f"seed {row.get('seed')}: {row['problem']}" for row in rows if row.get("problem")]
    return found | ({"problem": problems[0]} if problems else {}) | {"runs": rows}


def file_name(name: str) -> str:
    """The name as that of a folder."""
    return name.replace("/", "_").replace(" ", "_")


def last_line(text: str) -> str:
    """Where programs say what went wrong."""
    return (text.strip().splitlines() or [""])[-1].removeprefix("vitamin3d: ")


# --- the table -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Column:
    """A figure of the rows."""

    head: str
    key: str
    decimals: int = 0
    significant: int = 0
    """Digits, where it may be of any size."""
    factor: float = 1.0

    def cell(self, row: Row, earlier: Row | None = None) -> str:
        """The figure, with its change since the earlier row; `-` for none."""
        value, old = row.get(self.key), (earlier or {}).get(self.key)
        if value is None:
            return "-" if old is None else f"- (was {self._shown(old, self._places(old))})"
        places = self._places(value)
        shown = f"{row['placed']}/{row['pictures']}" if self.key == "success_rate" and "placed" in row else self._shown(value, places)
        if old is None:
            return shown
        change = self._shown(value - old, places, "+")
        return f"{shown} ({change if float(change) else '='})"

    def _shown(self, value: float, places: int, sign: str = "") -> str:
        return f"{self.factor * value:{sign}.{places}f}"

    def _places(self, value: float) -> int:
        size = abs(self.factor * value)
        return self.decimals if not self.significant or not size else max(0, min(6, self.significant - 1 - math.floor(math.log10(size))))


COLUMNS = (
    Column("frames %", "success_rate", 1, factor=100.0),
    Column("visible %", "success_visible", 1, factor=100.0),
    Column("maps", "maps"),
    Column("ATE %", "ate_percent_of_path", significant=3),
    Column("ATE cm", "ate_cm", significant=3),
    Column("spread", "scale_spread", significant=4),
    Column("wrong", "wrong_frames"),
    Column("ms", "tracked_ms", 1),
    Column("ms lost", "not_localised_ms", 1),
    Column("CPU s", "cpu_seconds", 1),
    Column("MB", "peak_memory_mb"),
    Column("exit", "exit_code"),
)


def table(rows: dict[str, Row], earlier: dict[str, Row] | None = None) -> str:
    """One line per row, in their order, beside the earlier ones; what went wrong below."""
    lines = [["", *(column.head for column in COLUMNS)]]
    for name, row in rows.items():
        lines.append([name, *(column.cell(row, (earlier or {}).get(name)) for column in COLUMNS)])
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    text = ["  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip() for line in lines]
    return "\n".join([*text, *(f"{name}: {row['problem']}" for name, row in rows.items() if row.get("problem"))])


def progress(name: str, row: Row) -> str:
    """A row as a plain line, without what it does not have."""
    figures = [f"{column.head} {cell}" for column in COLUMNS if (cell := column.cell(row)) != "-"]
    return f"{name}: " + ", ".join([*figures, *([row["problem"]] if row.get("problem") else [])])


def title(variant: Variant) -> str:
    """The line above a table."""
    return variant.name + (f" ({', '.join(f'{key} = {value}' for key, value in variant.settings)})" if variant.settings else "")


def earlier_rows(tables: dict[str, Any], name: str) -> dict[str, Row]:
    """Those of the table of that name, else of the first."""
    found: dict[str, Row] = (tables.get(name) or next(iter(tables.values()), {"rows": {}}))["rows"]
    return found


def read_earlier(path: Path) -> dict[str, Any]:
    """The tables of an earlier --json."""
    try:
        tables = json.loads(path.read_text())["tables"]
        if all(isinstance(row, dict) for found in tables.values() for row in found["rows"].values()):
            return dict(tables)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        pass
    raise InputError(f"{path}: not a readable file of this tool's --json")


# --- the command -----------------------------------------------------------------------------------------------------


def in_workers(work: Callable[[Target], Row], chosen: list[Target], workers: int) -> Iterator[tuple[Target, Row]]:
    """What becomes of each target, as they are done; the threads only wait for the processes that they start."""
    executor = ThreadPoolExecutor(workers)
    try:
        futures = {executor.submit(work, target): target for target in chosen}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        executor.shutdown(cancel_futures=True)


def rendered(place: ProvingGround, chosen: list[Target], workers: int) -> int:
    """Renders what is lacking; 1 where something could not be."""

    def work(target: Target) -> Row:
        there, begun = is_rendered(place.ground / target.name), time.monotonic()
        try:
            render(target, place.shared, place.ground, place.render_threads)
        except Vitamin3dError as error:
            return {"problem": str(error)}
        return {"said": "already rendered" if there else f"rendered in {time.monotonic() - begun:.0f} s"}

    failed = False
    for target, told in in_workers(work, [target for target in chosen if target.group == RECIPES], workers):
        failed |= "problem" in told
        print(f"{target.name}: {told.get('problem') or told['said']}", flush=True)
    return int(failed)


def proved(place: ProvingGround, chosen: list[Target], tried: list[Variant], arguments: argparse.Namespace) -> int:
    """Runs everything once per variant and prints a table each; 1 where something could not be measured."""
    earlier = read_earlier(arguments.against) if arguments.against else None
    tables: dict[str, Any] = {}
    for variant in tried:
        rows: dict[str, Row] = {}
        tables[variant.name] = {"settings": dict(variant.settings), "options": list(place.options), "rows": rows}
        for target, row in in_workers(partial(place.measure, variant), chosen, arguments.workers):
            print(progress(target.name if len(tried) == 1 else f"{variant.name}: {target.name}", row), flush=True)
            done = rows | {target.name: row}
            rows.clear()
            rows.update({t.name: done[t.name] for t in chosen if t.name in done})
            if arguments.json:
                write_file(arguments.json, [(json.dumps({"tables": tables}, indent=1) + "\n").encode()])
        print(f"\n{title(variant)}\n{table(rows, earlier_rows(earlier, variant.name) if earlier else None)}\n", flush=True)
    return int(any(row["exit_code"] is None for found in tables.values() for row in found["rows"].values()))


def loaded_score(shared: Path) -> Any:
    """The module score.py of the shared folder."""
    spec = importlib.util.spec_from_file_location("shared_score", shared / "score" / "score.py")
    if spec is None or spec.loader is None:
        raise InputError(f"{shared}: score/score.py cannot be loaded")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="what to run; default: everything but fisheye_room")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared", help="recipes, films, cases, score.py")
    parser.add_argument("--ground", type=Path, default=ROOT.parent / "proving", help="where rendered sequences are kept")
    parser.add_argument("--results", type=Path, metavar="FOLDER", help="keep what the runs write; default: a temporary folder")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="so many at a time")
    parser.add_argument("--frames", type=int, metavar="N", help="render at most so many; their names end in _N")
    parser.add_argument("--case-seeds", type=int, default=5, metavar="N", help=f"runs of {STRAY}, seeds 0 to N - 1")
    parser.add_argument("--mesh", action="store_true", help="with meshes")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="a setting, of all tables")
    parser.add_argument("--ablate", action="append", default=[], metavar="NAME[:SECTION.KEY=VALUE,...]", help="a table of its own")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, after each row")
    parser.add_argument("--against", type=Path, metavar="FILE", help="show the changes since an earlier --json")
    parser.add_argument("--timeout", type=float, default=3600.0, metavar="SECONDS", help="of one run")
    parser.add_argument("--list", action="store_true", help="what there is, and what is rendered")
    parser.add_argument("--render-only", action="store_true")
    return parser.parse_args(argv)


def checked(arguments: argparse.Namespace) -> None:
    """InputError for options that make no sense."""
    if min(arguments.workers, arguments.case_seeds) < 1 or (arguments.frames is not None and arguments.frames < 2):
        raise InputError("--workers and --case-seeds must be at least 1, --frames at least 2")
    if arguments.ground.resolve().is_relative_to(ROOT):
        raise InputError(f"--ground {arguments.ground}: inside the repository; rendered sequences belong outside")
    if arguments.json is not None and not arguments.json.resolve().parent.is_dir():
        raise InputError(f"--json {arguments.json}: its folder does not exist; make it, or choose another")


def run(arguments: argparse.Namespace) -> int:
    """What the command line asks for."""
    checked(arguments)
    shared, ground = arguments.shared.resolve(), arguments.ground.resolve()
    names = catalogue(shared)
    if arguments.list:
        print(listing(names, ground))
        return 0
    chosen, tried = selected(arguments.names, names, arguments.frames), variants(arguments.set, arguments.ablate)
    if arguments.against:
        read_earlier(arguments.against)  # before hours are spent
    with tempfile.TemporaryDirectory(prefix="proving_ground_") as temporary:
        place = ProvingGround(
            shared,
            ground,
            (arguments.results or Path(temporary)).resolve(),
            loaded_score(shared),
            case_seeds=arguments.case_seeds,
            render_threads=max(1, (os.cpu_count() or 1) // arguments.workers),
            timeout_s=arguments.timeout,
            keep=arguments.results is not None,
        )
        if arguments.mesh:
            place = dataclasses.replace(place, options=tuple(option for option in place.options if option != "--no-mesh"))
        if arguments.render_only:
            return rendered(place, chosen, arguments.workers)
        return proved(place, chosen, tried, arguments)


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; 2 with one line for bad input."""
    try:
        return run(parsed(argv))
    except Vitamin3dError as error:
        print(f"proving_ground: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("proving_ground: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
