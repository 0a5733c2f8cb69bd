# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

from vitamin3d.config import Config
from vitamin3d.map_output import MapOutput
from vitamin3d.run_statistics import frame_table, live_table
from vitamin3d.runtime import RunRecord
from vitamin3d.scale import Scale
from vitamin3d.types import SlamState, StepTimes


def test_lags_count_from_when_a_view_is_in_the_volume():
    """The first three wait for the choice of the voxels; how long is a figure of its own."""
    clock = SimpleNamespace(seconds_since=lambda timestamp_ns: 10.0 - timestamp_ns / 1e9)
    dense = MapOutput(None, Config(), None, Scale(), StepTimes(), clock)
    first, later = ([SimpleNamespace(timestamp_ns=int(1e9 * t)) for t in times] for times in ((5.0, 6.0, 7.0), (8.5,)))
    for fused in ([], [], first, later):
        dense.note_lags(fused)
    assert dense.mesh_begins == 5.0 and dense.mesh_lags == [1.5]
    record = RunRecord(latencies=[(0, 0.01), (1, 0.07)])
    table = live_table(record, dense.mesh_lags, dense.mesh_begins)["realtime"]
    assert table["mesh_begins_seconds"] == 5.0 and table["mesh_lag_seconds"]["worst"] == 1.5
    assert table["late_frames"] == [[1, 70.0]] and table["late_share"] == 0.5


def test_frames_have_two_prices():
    record = RunRecord(front_end_seconds=[0.004, 0.006, 0.005])
    assert frame_table(record) == {"tracked": None, "not_localised": None}
    states = (SlamState.INITIALIZING, SlamState.TRACKING, SlamState.UNCERTAIN, SlamState.TRACKING, SlamState.LOST)
    record.frame_seconds = list(zip(states, (0.002, 0.010, 0.030, 0.012, 0.050), strict=True))
    assert frame_table(record) == {"tracked": 17.0, "not_localised": 31.0}
