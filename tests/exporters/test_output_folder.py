# SPDX-License-Identifier: Apache-2.0
"""Files find their maps' folders."""

import pytest

from vitamin3d.errors import OutputError
from vitamin3d.exporters.output_folder import OutputFolder


def with_views(output, number):
    folder = output.map_folder(number)
    for name in ("depth", "normals"):
        (folder.path / name).mkdir()
        (folder.path / name / f"{number}.png").write_text(str(number))
    return folder


@pytest.mark.parametrize("ranks", [[2, 1], [1, 2, 3], [3, 1, 2], [None, 1], [2, None, 1], [None]])
def test_folders_are_put_in_the_order_of_size(tmp_path, ranks):
    output = OutputFolder(tmp_path)
    folders = [with_views(output, number) for number in range(1, len(ranks) + 1)]
    output.arrange(folders, ranks)
    for birth, rank in enumerate(ranks, 1):
        for name in ("depth", "normals"):
            places = [path.parents[1] for path in tmp_path.rglob(f"{name}/{birth}.png")]
            assert places == ([] if rank is None else [output.map_folder(rank).path])
    there = [rank for rank in ranks if rank not in (None, 1)]
    assert sorted(path.name for path in tmp_path.glob("maps/*")) == sorted(map(str, there))
    assert (tmp_path / "maps").exists() is bool(there)


def test_a_map_without_views_is_no_obstacle(tmp_path):
    output = OutputFolder(tmp_path)
    output.arrange([output.map_folder(1), with_views(output, 2)], [2, 1])
    assert (tmp_path / "depth" / "2.png").exists() and (tmp_path / "maps" / "2").is_dir()


def test_maps_of_an_earlier_run_are_refused_or_removed(tmp_path):
    OutputFolder(tmp_path).map_folder(2)
    with pytest.raises(OutputError, match=r"already holds a result \(maps\)"):
        OutputFolder(tmp_path)
    OutputFolder(tmp_path, overwrite=True)
    assert not (tmp_path / "maps").exists()
