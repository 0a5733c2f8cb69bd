# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from vitamin3d.commands.process import keep_freed_memory
{call}
faults = []
for _ in range(6):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [np.ones(1 << 18) for _ in range(8)]
    del blocks
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(min(faults[1:]))
"""


def faults(call):
    done = subprocess.run([sys.executable, "-c", FAULTS.format(call=call)], capture_output=True, text=True, check=True, timeout=120)
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc alone is told to keep memory")
def test_freed_memory_is_kept():
    assert faults("keep_freed_memory()") < 50 < 1000 < faults("")


@pytest.mark.slow
def test_open3d_comes_without_what_is_not_used():
    script = """
import sys
from vitamin3d.commands.process import prepare
prepare()
from vitamin3d.dense.tsdf_fusion import BACKENDS, check_backend
for backend in BACKENDS:
    check_backend(backend)
print(*({"sklearn", "pandas", "plotly", "dash"} & set(sys.modules)), "nothing else")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout == "nothing else\n"
