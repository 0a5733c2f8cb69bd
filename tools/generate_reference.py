# SPDX-License-Identifier: Apache-2.0
"""Writes the reference pages of the command line and of the settings, from the code itself.

    python tools/generate_reference.py FOLDER       # command-line.md and settings.md

The documentation is built with them (`make docs`): mkdocs loads this file as a hook, so the two pages are neither stored in the
repository nor ever out of date.
"""

import argparse
import ast
import dataclasses
import inspect
import sys
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer

from vitamin3d.cli import app
from vitamin3d.config import CHOICES, Config, live_config, paper_config
from vitamin3d.errors import Vitamin3dError
from vitamin3d.exporters.files import write_file

FOLDER = "reference"
"""Of the pages, in the documentation."""
COMMANDS = """# Command line

What `vitamin3d COMMAND --help` prints. Exit codes: [files and conventions](files.md#exit-codes).
"""
SETTINGS = """# Settings

`vitamin3d config` prints all settings as TOML (`--mode paper`, `--live`: the other named ones). Put those that you want to change into a
file and give it with `--config FILE`; names, types and values are checked. Read a group from top to bottom: a sentence may go on in the
next line.
"""


def command_line_page() -> str:
    """A section for each command: its text, its arguments and options."""
    group: Any = typer.main.get_command(app)
    return "\n".join([COMMANDS, *(_command(name, command) for name, command in group.commands.items())])


def _command(name: str, command: Any) -> str:
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join(["vitamin3d", name, *command.collect_usage_pieces(context)])
    records = [record for parameter in command.params if (record := parameter.get_help_record(context)) is not None]
    rows = _table(("argument or option", "meaning"), [(f"`{names.strip()}`", text) for names, text in records]) if records else ""
    return f"## vitamin3d {name}\n\n{inspect.cleandoc(command.help or '')}\n\n```\n{usage}\n```\n\n{rows}"


def settings_page() -> str:
    """A section for each group of settings: what it is about, and each setting with its values and meaning."""
    named = {"paper": paper_config(), "live": live_config(Config())}
    groups = [(f.name, getattr(Config(), f.name)) for f in dataclasses.fields(Config)]
    tops = [(f"`{name}`", f"`{_toml(value)}`") for name, value in groups if not dataclasses.is_dataclass(value)]
    sections = [SETTINGS, _table(("setting", "default"), tops)]
    for name, group in groups:
        if dataclasses.is_dataclass(group):
            rows = _settings(name, group, {mode: getattr(config, name) for mode, config in named.items()})
            sections.append(f"## [{name}]\n\n{_docstring(type(group))}\n\n{_table(('setting', 'default', 'meaning'), rows)}")
    return "\n".join(sections)


def _settings(name: str, group: Any, named: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Name, values and meaning of each setting of a group."""
    meanings = _meanings(type(group))
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        others = [(mode, getattr(other, field.name)) for mode, other in named.items()]
        values = [f"`{_toml(value)}`", *(f"{mode}: `{_toml(other)}`" for mode, other in others if other != value)]
        choices = [f"One of {', '.join(f'`{choice}`' for choice in CHOICES[key])}."] if (key := f"{name}.{field.name}") in CHOICES else []
        yield f"`{field.name}`", "; ".join(values), " ".join([*meanings.get(field.name, "").split(), *choices])


def _meanings(group: type) -> dict[str, str]:
    """The text below each field of a dataclass: Python keeps it in the source alone."""
    (body,) = (node.body for node in ast.parse(inspect.getsource(group)).body if isinstance(node, ast.ClassDef))
    found: dict[str, str] = {}
    for field, below in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
            found[field.target.id] = ast.literal_eval(below.value)
    return found


def _docstring(group: type) -> str:
    return inspect.cleandoc(group.__doc__ or "")


def _toml(value: Any) -> str:
    """A value as the settings' file has it; what is None is left out there."""
    if value is None:
        return "(none)"
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Markdown; a `|` would end a cell."""
    lines = [head, ("---",) * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def pages() -> dict[str, str]:
    """File name -> text of the generated pages."""
    return {"command-line.md": command_line_page(), "settings.md": settings_page()}


def on_files(files: Any, config: Any) -> Any:
    """Called by mkdocs when it has listed the pages: adds ours."""
    from mkdocs.structure.files import File  # type: ignore[import-not-found]

    for name, text in pages().items():
        files.append(File.generated(config, f"{FOLDER}/{name}", content=text))
    return files


def main(argv: list[str] | None = None) -> int:
    """Writes both pages into a folder; 2 where it cannot be written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args(argv).folder
    try:
        for name, text in pages().items():
            write_file(folder / name, [text.encode()])
            print(folder / name)
    except Vitamin3dError as error:
        print(f"generate_reference: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
