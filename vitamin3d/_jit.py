# SPDX-License-Identifier: Apache-2.0
"""The one numba decorator of the project (only `_simd.py` imports numba besides).

`nogil` lets the threads of `runtime.py` overlap, `cache` keeps compiled kernels between runs. Never `parallel`
(two Python threads inside parallel kernels abort the process) and never `fastmath` (NaN is our "invalid").
"""

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

ROOT = Path(__file__).parent
STAMP = "inlined.sha1"
"""In `__pycache__`: of which inlined functions the kernels beside it were compiled."""
CALLED_BY_KERNELS = b"@inlined", b"@intrinsic", b"def solve_6x6"
"""What a file has that holds functions which kernels of other files call."""
_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(function: _Function) -> _Function:
    """Compiles `function` with numba on its first call, without the GIL, cached on disk."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]


def inlined(function: _Function) -> _Function:
    """Like `kernel`, for the small functions that kernels call: LLVM always inlines them."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function)  # type: ignore[no-any-return]


def kernels_are_cached() -> bool:
    """Whether an earlier run has left compiled kernels beside this package (or in `NUMBA_CACHE_DIR`)."""
    folders = [ROOT, *([Path(numba.config.CACHE_DIR)] if numba.config.CACHE_DIR else [])]
    return any(next(folder.rglob("*.nbi"), None) is not None for folder in folders)


def forget_stale_kernels(root: Path = ROOT) -> None:
    """Removes the compiled kernels beside a package when a file whose functions they call has changed: numba does not see that.

    After an update of the checkout they would hold the old functions, or ask for modules that are gone. Nothing happens where files cannot
    be written: then they are not cached here either.
    """
    sources = [(path, path.read_bytes()) for path in sorted(root.rglob("*.py"))]
    digest = hashlib.sha1(usedforsecurity=False)
    for path, text in sources:
        if any(word in text for word in CALLED_BY_KERNELS):
            digest.update(str(path.relative_to(root)).encode() + text)
    stamp = root / "__pycache__" / STAMP
    with contextlib.suppress(OSError):
        if not stamp.exists() or stamp.read_text() != digest.hexdigest():
            for index in root.rglob("*.nbi"):
                index.unlink(missing_ok=True)
            stamp.parent.mkdir(exist_ok=True)
            stamp.write_text(digest.hexdigest())


forget_stale_kernels()
