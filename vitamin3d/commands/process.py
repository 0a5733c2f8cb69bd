# SPDX-License-Identifier: Apache-2.0
"""What all commands share: exit codes and the environment of the process."""

import os

EXIT_BROKEN, EXIT_ERROR, EXIT_NO_MAP, EXIT_INTERRUPTED = 1, 2, 3, 130
ONE_THREAD_EACH = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread_each() -> None:
    """OpenMP spins when threads outnumber cores: our threads do the overlapping. Before the libraries load."""
    for name in ONE_THREAD_EACH:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
