# SPDX-License-Identifier: Apache-2.0
from vitamin3d.run_gaps import Cause, Gap, gaps_table
from vitamin3d.run_report import _sections

GAP = Gap(3, 9, 10**9, 2 * 10**9, 7, Cause.PLAIN, "frames 3–9 (0.1–0.3 s): lost on a plain wall", "step back")


def test_sections_of_the_report():
    entry = {"folder": ".", "frames": 1200, "keyframes": 40, "cloud_points": 5000, "scale": {"known": False}}
    maps = [entry | {"number": 1, "first_frame_s": 1012.0, "last_frame_s": 1020.5}]
    assert _sections({"maps": maps, "not_localised": [], "first_frame_s": 1000.0}) == []
    maps.append(entry | {"number": 2, "folder": "maps/2", "first_frame_s": 1000.5, "last_frame_s": 1003.0})
    first, second = _sections({"maps": maps, "not_localised": gaps_table([GAP]), "first_frame_s": 1000.0})
    assert "<td>1,200</td><td>12.00</td><td>20.50</td>" in first and "<td>maps/2</td>" in first
    assert "<tr><td>frames 3–9 (0.1–0.3 s)</td><td>lost on a plain wall</td><td>step back</td></tr>" in second
