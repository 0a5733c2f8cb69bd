# SPDX-License-Identifier: Apache-2.0
import pytest

from vitamin3d.benchmark.sequences import names_of, sequences_of
from vitamin3d.errors import InputError


@pytest.mark.parametrize(
    ("kind", "files"),
    [
        ("euroc", ["{}/mav0/cam0/data.csv", "{}/mav0/cam0/sensor.yaml"]),
        ("tum", ["{}/rgb.txt"]),
        ("icl", ["{}/associations.txt", "{}/rgb/0.png"]),
        ("7scenes", ["{}/frame-000000.color.png"]),
        ("kitti", ["sequences/{}/times.txt", "sequences/{}/image_0/000000.png"]),
    ],
)
def test_all_sequences_are_found_and_no_others(tmp_path, kind, files):
    for name in ("seq_10", "seq_2", "other"):
        for file in files if name != "other" else ["{}/notes.txt"]:
            path = tmp_path / file.format(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    found = sequences_of(kind, tmp_path)
    assert names_of(found) == ["seq_2", "seq_10"]
    assert sequences_of(kind, found[0]) == [found[0]]
    with pytest.raises(InputError, match=r"no (tum|euroc) sequence"):
        sequences_of("tum" if kind != "tum" else "euroc", tmp_path)


def test_names_differ_even_where_folders_do_not(tmp_path):
    assert names_of([tmp_path / "chess" / "seq-01", tmp_path / "fire" / "seq-01"]) == ["chess_seq-01", "fire_seq-01"]
