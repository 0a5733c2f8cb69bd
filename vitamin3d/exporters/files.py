# SPDX-License-Identifier: Apache-2.0
"""The one way that files are written: complete or not at all."""

import os
from collections.abc import Iterable
from pathlib import Path

from vitamin3d.errors import OutputError


def write_file(path: Path, parts: Iterable[bytes]) -> None:
    """Writes the parts to a temporary name in the same folder, then renames: `path` is complete or as it was.

    Raises:
        OutputError: the disk is full, or the folder is missing or not writable.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            for part in parts:
                file.write(part)
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); free the disk or choose another --out") from None
    finally:
        _remove(temporary)


def _remove(temporary: Path) -> None:
    try:
        temporary.unlink(missing_ok=True)
    except OSError:
        return  # the folder itself is out of reach: nothing was written
