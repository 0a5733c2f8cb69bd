# SPDX-License-Identifier: Apache-2.0
"""What all commands share: exit codes and the environment of the process."""

import ctypes
import os
import sys
from types import ModuleType

EXIT_BROKEN, EXIT_ERROR, EXIT_NO_MAP, EXIT_INTERRUPTED = 1, 2, 3, 130
UNUSED_PARTS_OF_OPEN3D = ("open3d.ml", "open3d.visualization.draw_plotly")
ONE_THREAD_EACH = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Of malloc.h."""
KEPT_BYTES = 256 << 20


def prepare() -> None:
    """What every command begins with, before the libraries load."""
    one_thread_each()
    keep_freed_memory()
    skip_unused_imports()


def one_thread_each() -> None:
    """OpenMP spins when threads outnumber cores: our threads do the overlapping. Before the libraries load."""
    for name in ONE_THREAD_EACH:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def keep_freed_memory() -> None:
    """Each frame needs the same few megabytes anew: tells glibc to keep what is freed, blocks of any size, instead of returning it
    to the system (800 page faults a frame, a fifth of the front end's time). Elsewhere it does nothing."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


def skip_unused_imports() -> None:
    """Open3D's import brings its machine-learning data sets along, with scikit-learn and pandas, and a web server for plots: most of
    its two seconds. The command line needs none of them. Before Open3D loads."""
    for name in UNUSED_PARTS_OF_OPEN3D:
        stand_in = ModuleType(name)
        stand_in.__dict__["__getattr__"] = lambda attribute: None  # whatever Open3D takes from it
        sys.modules.setdefault(name, stand_in)
