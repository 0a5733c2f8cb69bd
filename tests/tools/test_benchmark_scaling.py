# SPDX-License-Identifier: Apache-2.0
import sys
import xml.etree.ElementTree as xml
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
import benchmark_scaling


def test_four_curves_in_one_picture():
    curve = {"ours": [(1.0, 2.0), (5.0, 9.0)], "theirs": [(1.0, 3.0), (5.0, 30.0)]}
    groups = dict.fromkeys(benchmark_scaling.TITLES, curve)
    drawn = xml.fromstring(benchmark_scaling.picture(groups))
    inner = [child for child in drawn if child.tag.endswith("svg")]
    assert {(child.get("x"), child.get("y")) for child in inner} == {("0", "0"), ("520", "0"), ("0", "300"), ("520", "300")}
