# SPDX-License-Identifier: Apache-2.0
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vitamin3d.datasets.tables import nanoseconds_from_seconds
from vitamin3d.timestamps import seconds_from_nanoseconds


@given(st.integers(-(2**63) + 1, 2**63 - 1))
def test_times_are_exact(timestamp_ns: int) -> None:
    assert nanoseconds_from_seconds(seconds_from_nanoseconds(timestamp_ns)) == timestamp_ns


@pytest.mark.parametrize(
    ("text", "expected"),
    [("1.000000", 10**9), ("1.403715284312143104e+09", 1403715284312143104), ("-0.5", -500_000_000), ("0.0000000015", 2), ("7", 7 * 10**9)],
)
def test_seconds_of_other_tools(text: str, expected: int) -> None:
    assert nanoseconds_from_seconds(text) == expected


@pytest.mark.parametrize("text", ["nan", "inf", "one", "", "1e300"])
def test_no_time(text: str) -> None:
    with pytest.raises(ValueError):
        nanoseconds_from_seconds(text)
