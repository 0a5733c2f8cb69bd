# SPDX-License-Identifier: Apache-2.0
"""The one numba decorator of the project (only `_lanes.py` imports numba besides).

`nogil` lets the threads of `runtime.py` overlap, `cache` keeps compiled kernels between runs. Never `parallel`
(two Python threads inside parallel kernels abort the process) and never `fastmath` (NaN is our "invalid").
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(function: _Function) -> _Function:
    """Compiles `function` with numba on its first call, without the GIL, cached on disk."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]


def inlined(function: _Function) -> _Function:
    """Like `kernel`, for the small functions that kernels call: LLVM always inlines them."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function)  # type: ignore[no-any-return]


def kernels_are_cached() -> bool:
    """Whether an earlier run has left compiled kernels beside this package (or in `NUMBA_CACHE_DIR`)."""
    folders = [Path(__file__).parent, *([Path(numba.config.CACHE_DIR)] if numba.config.CACHE_DIR else [])]
    return any(next(folder.rglob("*.nbi"), None) is not None for folder in folders)
