# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in text files, with times that come in exactly: no time goes through a float."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation
from fractions import Fraction
from math import isfinite
from pathlib import Path

from vitamin3d.errors import InputError
from vitamin3d.timestamps import NANOSECONDS, seconds_from_nanoseconds


@dataclass(frozen=True)
class Row:
    """A line of a table that is neither empty nor a comment."""

    path: Path
    line: int
    fields: list[str]

    def fail(self, what: str) -> InputError:
        """The error for this line."""
        return InputError(f"{self.path}, line {self.line}: {what}")

    def numbers(self, fields: Sequence[str]) -> list[float]:
        """Finite floats of some of the fields."""
        try:
            values = [float(field) for field in fields]
        except ValueError:
            raise self.fail(f"expected numbers, found {' '.join(fields)!r}; correct or remove the line") from None
        if not all(isfinite(value) for value in values):
            raise self.fail("the numbers must be finite; correct or remove the line")
        return values


def read_text(path: Path) -> str:
    """The text of a file; InputError where it is not there or no text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; check the path") from None


def rows_of(path: Path, columns: str, separator: str | None = None) -> Iterator[Row]:
    """The rows of a table; `columns` names the fields that each row must have, as the error message shows them."""
    for line, text in enumerate(read_text(path).splitlines(), start=1):
        stripped = text.strip()
        if not stripped or stripped.startswith("#"):
            continue
        row = Row(path, line, [field.strip() for field in stripped.split(separator)])
        if len(row.fields) < len(columns.split()):
            raise row.fail(f"expected `{columns}`, found {stripped[:60]!r}")
        yield row


def nanoseconds_from_seconds(text: str) -> int:
    """Integer nanoseconds of decimal seconds; exact to nine decimals, rounded beyond. ValueError for anything else."""
    try:
        value = int((Decimal(text) * NANOSECONDS).to_integral_value(ROUND_HALF_EVEN))
    except (InvalidOperation, OverflowError):
        raise ValueError(text) from None
    if abs(value) >= 2**63:
        raise ValueError(text)
    return value


def row_seconds(row: Row) -> int:
    """Nanoseconds of a row's first field in seconds."""
    try:
        return nanoseconds_from_seconds(row.fields[0])
    except ValueError:
        raise row.fail(f"expected a time in seconds, found {row.fields[0]!r}") from None


def row_nanoseconds(row: Row) -> int:
    """Nanoseconds of a row's first field in integer nanoseconds."""
    field = row.fields[0]
    if not (field.isascii() and field.isdigit() and int(field) < 2**63):
        raise row.fail(f"expected a time in integer nanoseconds, found {field!r}")
    return int(field)


def check_ascending(timestamps_ns: Sequence[int], rows: Sequence[Row]) -> None:
    """InputError at the first row whose time is not after the one before."""
    for before, after, row in zip(timestamps_ns, timestamps_ns[1:], rows[1:], strict=False):
        if after <= before:
            relation = "equal to" if after == before else "before"
            raise row.fail(
                f"time {seconds_from_nanoseconds(after)} s is {relation} that of the line above; sort the file by time and remove doubles"
            )


def regular_timestamps(count: int, rate_hz: Fraction) -> list[int]:
    """Nanoseconds of `index / rate`, rounded once."""
    return [round(index * NANOSECONDS / rate_hz) for index in range(count)]
