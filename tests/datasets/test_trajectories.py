# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from vitamin3d.datasets.trajectories import read_tum
from vitamin3d.errors import InputError


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1.0 0 0 0 0 0 0", "line 3: expected `t tx"),
        ("1.0 0 0 x 0 0 0 1", "line 3: expected numbers"),
        ("1.0 0 0 nan 0 0 0 1", "line 3: the numbers must be finite"),
        ("1.0 0 0 0 0 0 0 0", "line 3: the quaternion"),
        ("0.5 0 0 0 0 0 0 1", "line 3: time 0.500000000 s is equal to"),
        ("0.4 0 0 0 0 0 0 1", "line 3: time 0.400000000 s is before"),
        ("t 0 0 0 0 0 0 1", "line 3: expected a time in seconds, found 't'"),
    ],
)
def test_bad_lines(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(f"# comment\n0.5 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError) as caught:
        read_tum(path)
    assert str(caught.value).startswith(f"{path}, {message}")


def test_not_a_text(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match="not a text file"):
        read_tum(tmp_path / "t.tum")
    with pytest.raises(InputError, match="cannot be read"):
        read_tum(tmp_path / "none.tum")
