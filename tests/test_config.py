# SPDX-License-Identifier: Apache-2.0
import dataclasses

import pytest

from vitamin3d.config import AT_LEAST_ONE, CHOICES, Config, dump_toml, load_toml, paper_config
from vitamin3d.errors import InputError


def written(tmp_path, text):
    path = tmp_path / "settings.toml"
    path.write_text(text)
    return path


def refused(tmp_path, text):
    with pytest.raises(InputError) as caught:
        load_toml(written(tmp_path, text))
    assert "settings.toml" in str(caught.value) and "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("config", [Config(), paper_config()], ids=["default", "paper"])
def test_all_settings_go_out_and_come_back(tmp_path, config):
    assert load_toml(written(tmp_path, dump_toml(config))) == config


def test_a_file_changes_only_what_it_names(tmp_path):
    path = written(tmp_path, "seed = 7\n[extrema]\nmax_tracks = 99\n[fusion]\nvoxel_low = 2\n")
    config = load_toml(path, paper_config())
    expected = dataclasses.replace(paper_config(), seed=7)
    expected = dataclasses.replace(expected, extrema=dataclasses.replace(expected.extrema, max_tracks=99))
    expected = dataclasses.replace(expected, fusion=dataclasses.replace(expected.fusion, voxel_low=2.0))
    assert config == expected and isinstance(config.fusion.voxel_low, float)
    assert load_toml(written(tmp_path, "")) == Config()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sed = 1", "unknown setting sed"),
        ("[extrema]\nmax_trakcs = 1", "unknown setting extrema.max_trakcs"),
        ("[nothing]\na = 1", "unknown setting nothing"),
        ("extrema = 3", "extrema is a group of settings"),
        ("[seed]\na = 1", "seed must be like 0"),
        ("seed = 1.5", "seed must be like 0"),
        ("seed = true", "seed must be like 0"),
        ("seed = '1'", "seed must be like 0"),
        ("[recovery]\nenabled = 1", "recovery.enabled must be like True"),
        ("[extrema]\nmin_curvature = 'low'", "extrema.min_curvature must be like 0.15"),
        ("[fusion]\nvoxel_high = 'fine'", "fusion.voxel_high must be like None"),
        ("[extrema_tracking]\nprediction = 'dense-flow'", "extrema_tracking.prediction must be one of"),
        ("[bundle_adjustment]\nkeyframe_solver = 'ceres'", "bundle_adjustment.keyframe_solver must be one of"),
        ("[fusion]\nbackend = 'gpu'", "fusion.backend must be one of"),
        ("[extrema]\nmax_tracks = -1", "extrema.max_tracks must be a finite number"),
        ("[extrema]\nmin_curvature = nan", "extrema.min_curvature must be a finite number"),
        ("[extrema]\nmin_curvature = inf", "extrema.min_curvature must be a finite number"),
        ("[recovery]\ninterval = 0", "recovery.interval must be at least 1"),
        ("[extrema_tracking]\nflow_stride = 0", "extrema_tracking.flow_stride must be at least 1"),
        ("seed = ", "not a readable TOML file"),
        ("[extrema", "not a readable TOML file"),
    ],
)
def test_mistakes_are_named(tmp_path, text, words):
    assert words in refused(tmp_path, text)


def test_a_missing_file_a_folder_and_bytes_are_refused(tmp_path):
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(InputError, match="not a readable TOML file"):
            load_toml(path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a readable TOML file"):
        load_toml(binary)


def test_the_paper_differs_where_the_paper_does():
    paper = paper_config()
    assert paper.mode == "paper" and paper.extrema_tracking.prediction == "dominant_flow"
    assert not paper.recovery.enabled and paper.window.anchors == 0
    assert paper.bundle_adjustment.keyframe_solver == "subspace"
    assert paper.extrema.min_roundness == paper.extrema_tracking.min_roundness == 0.0  # "all extrema"
    assert not paper.continuity.enabled and not paper.rotation.enabled and not paper.relocalization.enabled
    assert paper.extrema.wanted == paper.extrema_tracking.gate_medians == paper.localization.votes == paper.triangulation.max_rms_px == 0
    assert (paper.triangulation.min_parallax_deg, paper.triangulation.parallax_deviations) == (1.0, 0.0)
    same = ("dominant_flow", "initialization", "nltgv", "atlas")
    assert all(getattr(paper, group) == getattr(Config(), group) for group in same)


def test_every_choice_and_limit_belongs_to_a_setting():
    for name in (*CHOICES, *AT_LEAST_ONE):
        group, setting = name.split(".")
        assert hasattr(getattr(Config(), group), setting), name
    for config in (Config(), paper_config()):
        assert all(getattr(getattr(config, n.split(".")[0]), n.split(".")[1]) in choices for n, choices in CHOICES.items())


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().extrema.max_tracks = 3
