# SPDX-License-Identifier: Apache-2.0
"""What importing the package and asking for help loads, and that the warm-up leaves nothing to compile."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

HEAVY = {"numpy", "scipy", "numba", "cv2", "open3d", "pymeshlab", "matplotlib", "vitamin3d.slam", "vitamin3d.job"}


def fresh(code, **environment):
    """What a Python of its own prints, and the seconds that it took."""
    begun = time.perf_counter()
    root = str(Path(__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=600, env={**os.environ, "PYTHONPATH": root, **environment}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, time.perf_counter() - begun


def test_importing_the_package_loads_nothing_heavy():
    said, seconds = fresh("import sys, vitamin3d; print(sorted(sys.modules))")
    assert not HEAVY & set(eval(said)) and "vitamin3d" in eval(said)
    assert seconds < 5  # 0.05 on an idle machine


def test_help_loads_nothing_heavy():
    code = "import sys\nfrom vitamin3d.cli import app\ntry: app(['reconstruct', '--help'])\nexcept SystemExit: "
    code += "print('\\n' + repr(sorted(sys.modules)))"
    said, seconds = fresh(code)
    modules = set(eval(said.splitlines()[-1]))
    assert "--realtime" in said and not HEAVY & modules and "typer" in modules
    assert seconds < 5  # 0.06 on an idle machine


def test_the_public_names_load_what_they_need_and_no_viewer():
    said, _ = fresh("import sys\nfrom vitamin3d import Slam, Config\nprint(sorted(sys.modules))")
    assert not {"open3d", "pymeshlab", "matplotlib"} & set(eval(said)) and "vitamin3d.slam" in eval(said)


@pytest.mark.slow
def test_after_the_warm_up_nothing_is_compiled(tmp_path):
    """A live and a default run of the demo add no kernel to the cache."""
    warm = "from vitamin3d.warmup import warm_up; warm_up()"
    fresh(warm, NUMBA_CACHE_DIR=str(tmp_path))
    kernels = {path.name for path in tmp_path.rglob("*.nbc")}
    assert len(kernels) > 30
    for options in ("--live", "--sequential", "--mode=paper"):
        arguments = ["reconstruct", "data/demo", "-q", "-o", str(tmp_path / "out"), "--overwrite", options]
        run = f"from vitamin3d.cli import app\ntry: app({arguments!r})"
        fresh(run + "\nexcept SystemExit as end: assert not end.code", NUMBA_CACHE_DIR=str(tmp_path))
        assert {path.name for path in tmp_path.rglob("*.nbc")} == kernels, options
