# SPDX-License-Identifier: Apache-2.0
"""The one numba decorator of the project (the only file that imports numba).

`nogil` lets the threads of `runtime.py` overlap, `cache` keeps compiled kernels between runs. Never `parallel`
(two Python threads inside parallel kernels abort the process) and never `fastmath` (NaN is our "invalid").
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(function: _Function) -> _Function:
    """Compiles `function` with numba on its first call, without the GIL, cached on disk."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]


def inlined(function: _Function) -> _Function:
    """Like `kernel`, for the small functions that kernels call: LLVM always inlines them."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function)  # type: ignore[no-any-return]
