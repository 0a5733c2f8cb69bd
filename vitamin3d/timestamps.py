# SPDX-License-Identifier: Apache-2.0
"""Time stamps as text; integers of nanoseconds inside, never floats."""

NANOSECONDS = 10**9


def seconds_from_nanoseconds(timestamp_ns: int) -> str:
    """Decimal seconds with nine decimals, exactly."""
    seconds, rest = divmod(abs(timestamp_ns), NANOSECONDS)
    return f"{'-' if timestamp_ns < 0 else ''}{seconds}.{rest:09d}"
