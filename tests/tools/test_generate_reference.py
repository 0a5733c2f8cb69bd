# SPDX-License-Identifier: Apache-2.0
"""The reference pages hold every command, option and setting; the documentation builds without a warning."""

import dataclasses
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from vitamin3d.config import Config

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location("generate_reference", ROOT / "tools" / "generate_reference.py")
tool = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tool)


def test_every_setting(tmp_path):
    assert tool.main([str(tmp_path)]) == 0
    text = (tmp_path / "settings.md").read_text()
    for group in dataclasses.fields(Config):
        value = getattr(Config(), group.name)
        if dataclasses.is_dataclass(value):
            section = text.split(f"## [{group.name}]")[1].split("\n## ")[0]
            assert all(f"| `{f.name}` | `" in section for f in dataclasses.fields(value))


def test_every_option():
    text = tool.command_line_page()
    for name in ("reconstruct", "evaluate", "compare", "figures", "benchmark", "warmup", "config", "version"):
        assert f"## vitamin3d {name}\n" in text
    assert "--refine-calibration <auto\\|on\\|off>" in text and "--keep-all" in text


def test_folder_that_is_not_there(tmp_path, capsys):
    assert tool.main([str(tmp_path / "no")]) == 2 and "no" in capsys.readouterr().err


@pytest.mark.slow
def test_documentation_builds(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for page in tmp_path.rglob("*.html"):
        assert not re.search(r"<(link|script|img|iframe)[^>]*\b(src|href)=\"(https?:)?//", page.read_text()), page
