# SPDX-License-Identifier: Apache-2.0
"""Every command of README, CONTRIBUTING and the documentation is one that there is, and the Python snippets run."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from vitamin3d.cli import app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
DEMO = (ROOT / "data" / "demo").as_posix()


def blocks(page, language):
    """The fenced blocks of a page in a language ("": none is named), without their indentation."""
    found = re.findall(r"^( *)```(\w*)\n(.*?)^\1```$", page.read_text(), re.MULTILINE | re.DOTALL)
    return [re.sub(f"^{indent}", "", text, flags=re.MULTILINE) for indent, name, text in found if name == language]


def commands():
    for page in PAGES:
        inline = re.findall(r"`((?:vitamin3d|python tools/|make )[^`\n]*)`", page.read_text())
        for line in [line for block in blocks(page, "") for line in block.splitlines()] + inline:
            for part in re.split(r"&&|;", line.split("#")[0]):
                words = shlex.split(re.sub(r"\$\(.*?\)|\[|\]", "", part)) if part.count("'") % 2 == 0 else part.split()
                if words and (Path(words[0]).name == "vitamin3d" or words[0] in ("make", "python")):
                    yield pytest.param(words, id=f"{page.name}: {' '.join(words)}"[:120])


COMMANDS = list(commands())


def test_there_are_commands_to_check():
    assert len(COMMANDS) > 30 and len({param.values[0][0] for param in COMMANDS}) >= 4


@pytest.mark.parametrize("words", COMMANDS)
def test_a_command_is_one_that_there_is(words):
    program, *rest = words
    if program == "make":
        targets = re.findall(r"^(\S+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert rest[0] in targets or rest[0].startswith("PYTHON=")
    elif program == "python":
        text = (ROOT / rest[0]).read_text()
        assert all(f'"{word}"' in text for word in rest[1:] if word.startswith("--"))
    elif rest and rest[0].isupper() is False:
        command = typer.main.get_command(app).commands[rest[0]]
        known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)} | {"--help"}
        assert all(word in known for word in rest[1:] if word.startswith("-") and not re.match(r"-\d", word))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
def test_the_python_snippets_run_one_after_the_other(tmp_path):
    page = ROOT / "docs" / "reference" / "python.md"
    snippets = [text for text in blocks(page, "python") if "make_problem" not in text]  # whose arrays are the reader's
    assert len(snippets) >= 3
    code = (
        "\n".join(snippets)
        .replace("data/demo", DEMO)
        .replace("max_frames=None", "max_frames=60")
        .replace("range(len(dataset))", "range(60)")
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "trajectory.tum").exists()
