# SPDX-License-Identifier: Apache-2.0
import pytest

from vitamin3d.benchmark.published import TABLE_1, euroc_name


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("MH_01_easy", "MH01"), ("V2_03_difficult", "V203"), ("MH05", "MH05"), ("v101", "V101"),
        ("room1_v101_easy", None), ("V1_04", None), ("MH_1", "MH01"),
    ],
)  # fmt: skip
def test_only_the_real_sequences_have_published_figures(name, key):
    assert euroc_name(name) == key


def test_published_figures():
    assert len(TABLE_1) == 11 and TABLE_1["V203"]["VITAMIN-E (paper)"].cm == (140.0, 5.2)
    assert TABLE_1["MH04"]["DSO"].success == (95.7, 0.0) and TABLE_1["V103"]["ORB-SLAM"].retries == (56, 26)
    assert all(cells["LSD-SLAM"].retries is None for cells in TABLE_1.values())
