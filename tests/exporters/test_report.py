# SPDX-License-Identifier: Apache-2.0
"""`report.html`: whole in itself, small enough, and alive in a browser without a network."""

import json
import re

import numpy as np
import pytest
from browser import opened

from vitamin3d.errors import InputError
from vitamin3d.exporters import report as module
from vitamin3d.exporters.rendering import jpeg
from vitamin3d.exporters.report import (
    Picture,
    Report,
    decimated,
    evaluation_section,
    quantised,
    report_html,
    section_table,
    with_evaluation,
)
from vitamin3d.run_report import read_truth_of
from vitamin3d.types import Surface


def sphere(rows=60):
    """A sphere of radius one around (0, 0, 4), red above and blue below."""
    theta, phi = np.meshgrid(np.linspace(0.01, np.pi - 0.01, rows), np.linspace(0, 2 * np.pi, rows))
    n = np.column_stack([(np.sin(theta) * np.cos(phi)).ravel(), np.cos(theta).ravel(), (np.sin(theta) * np.sin(phi)).ravel()])
    corner = (np.arange(rows - 1)[:, None] * rows + np.arange(rows - 1)).ravel()
    triangles = np.vstack([np.stack([corner, corner + rows, corner + 1], 1), np.stack([corner + 1, corner + rows, corner + rows + 1], 1)])
    colors = np.where(n[:, 1:2] < 0, [[220, 40, 40]], [[40, 40, 220]]).astype(np.uint8)
    return Surface(n + np.array([0, 0, 4.0]), triangles.astype(np.int32), n, colors)


def report(**changes):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.linspace(-1, 1, 5)
    surface = sphere()
    picture = Picture("frame 3 <b>", jpeg(np.full((40, 60, 3), 90, np.uint8)))
    content = {
        "surface": surface, "points": surface.vertices_world[::3], "colors": surface.colors[::3],
        "frames": [picture], "normal_maps": [picture],
        "plots": ["<svg></svg>"], "steps": {"track_extrema": {"count": 5, "median_ms": 1.0, "p95_ms": 2.0, "total_seconds": 3.0}},
        "stats": '{"a": 1}', "settings": "seed = 0",
    }  # fmt: skip
    return Report("a <run>", "unit: metre", [("99 %", "localised")], poses, poses[:, :3, 3], (0.6, 0.4), **(content | changes))


def scene_of(page):
    return json.loads(re.search('<script id="scene"[^>]*>(.*?)</script>', page)[1])


# --- the file --------------------------------------------------------------------------------------------------------


def test_nothing_is_asked_of_a_network():
    page = report_html(report())
    assert "default-src 'none'" in page
    assert re.findall(r'(?:src|href)\s*=\s*"(?!data:)', page) == []
    assert re.findall(r"https?://(?!www\.w3\.org/)", page) == []
    assert "import(" not in page and "fetch(" not in page and "XMLHttpRequest" not in page


def test_text_is_escaped_and_everything_is_there():
    page = report_html(report())
    assert "<title>a &lt;run&gt;</title>" in page and "frame 3 &lt;b&gt;" in page and "<b>frame" not in page
    for words in ("Tracked extrema", "Normal maps", "track extrema", "seed = 0", "99 %", "data:image/jpeg;base64,"):
        assert words in page
    scene = scene_of(page)
    assert scene["mesh"]["vertices"] == 3600 and scene["cloud"]["points"] == 1200 and len(scene["keyframes"]) == 5
    np.testing.assert_allclose(scene["up"], [0, -1, 0], atol=1e-9)
    assert scene["eye"][2] < scene["target"][2]


def test_a_table_of_its_own_is_before_the_view():
    page = report_html(report(sections=[section_table("Maps <2>", ("map", "frames"), [(1, "79"), (2, "<71>")])]))
    assert "<h2>Maps &lt;2&gt;</h2><table><tr><th>map</th><th>frames</th></tr><tr><td>1</td><td>79</td></tr>" in page
    assert "<td>&lt;71&gt;</td>" in page and page.index("Maps &lt;2&gt;") < page.index("<canvas")


def test_a_large_mesh_is_made_coarser_until_it_fits(monkeypatch):
    monkeypatch.setattr(module, "MAX_BYTES", 90_000)
    page = report_html(report(points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8)))
    assert len(page.encode()) <= 90_000 and 100 < scene_of(page)["mesh"]["vertices"] < 3600


def test_a_run_without_a_map_has_a_report():
    nothing = {"surface": None, "points": np.zeros((0, 3)), "colors": np.zeros((0, 3), np.uint8)}
    empty = Report("none", "", [], np.zeros((0, 4, 4)), np.zeros((0, 3)), (0.6, 0.4), **nothing)
    assert "There is no map" in report_html(empty)


def test_an_evaluation_is_put_in_and_replaced():
    page = report_html(report())
    once = with_evaluation(page, evaluation_section("ATE 1 < 2", ["<svg>one</svg>"]), np.zeros((10, 3)))
    assert "ATE 1 &lt; 2" in once and "<svg>one</svg>" in once and '<label class="truth">' in once
    twice = with_evaluation(once, evaluation_section("ATE 3", ["<svg>two</svg>"]), np.ones((9000, 3)))
    assert "ATE 1" not in twice and "<svg>one</svg>" not in twice and "ATE 3" in twice
    places = json.loads(re.search('<script id="truth"[^>]*>(.*?)</script>', twice)[1])
    assert len(places) == module.MAX_POSITIONS and places[0] == [1.0, 1.0, 1.0]


def test_backslashes_of_a_table_survive():
    assert r"C:\1\g<0>" in with_evaluation(report_html(report()), r"C:\1\g<0>", np.zeros((1, 3)))


def test_a_truth_that_cannot_be_read_is_none():
    class Broken:
        name = "broken"

        def ground_truth(self):
            raise InputError("data.csv, line 3: nonsense")

    assert read_truth_of(Broken()) is None


# --- the mesh --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("most", [100, 1000, 5000])
def test_decimation_keeps_the_shape(most):
    fine = sphere()
    coarse = decimated(fine, most)
    assert most / 4 < len(coarse.triangles) <= most
    radius = np.linalg.norm(coarse.vertices_world - [0, 0, 4.0], axis=1)
    assert radius.min() > 1 - 12 / most**0.75 - 0.02 and radius.max() < 1.0001
    a, b, c = (coarse.vertices_world[coarse.triangles[:, k]] for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(4 * np.pi, rel=0.25)
    assert (coarse.colors[coarse.vertices_world[:, 1] < -0.5] == [220, 40, 40]).all()


def test_a_small_mesh_is_left_alone():
    fine = sphere(10)
    assert decimated(fine, 1000) is fine


def test_places_are_exact_to_16_bits(rng):
    points = rng.uniform(-3, 5, (100, 3))
    packed, low, extent = quantised(points)
    np.testing.assert_allclose(packed / 65535 * extent + low, points, atol=0.5001 * max(extent) / 65535)
    flat, low, extent = quantised(np.ones((3, 3)))
    np.testing.assert_allclose(flat / 65535 * extent + low, 1.0, atol=1e-9)


# --- the browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    truth = np.column_stack([np.linspace(-1, 1, 50), np.full(50, -0.2), np.zeros(50)])
    path.write_text(with_evaluation(report_html(report()), evaluation_section("ATE", []), truth))
    with opened(path) as found:
        yield found


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.filterwarnings("ignore")
def test_the_page_is_alive(page):
    """Not blank, nobody complains, nothing is asked for, and the view follows the hand."""
    picture = page.picture().astype(int)
    assert page.evaluate("window.vitamin3dReport.triangles") == 2 * 59 * 59
    red, blue = ((picture[..., k] - picture[..., 2 - k] > 60).sum() for k in (2, 0))
    assert red > 2000 and blue > 2000
    assert page.evaluate("document.getElementById('hint').textContent").startswith("6,962 of 6,962 triangles")
    page.drag("view", 150, 60)
    assert (np.abs(page.picture().astype(int) - picture).max(axis=-1) > 30).mean() > 0.001
    page.click("home")
    assert (np.abs(page.picture().astype(int) - picture).max(axis=-1) > 30).mean() < 0.001
    for name in ("mesh", "trajectory", "keyframes", "truth"):
        before = page.picture().astype(int)
        page.click(f"show-{name}")
        assert (np.abs(page.picture().astype(int) - before).max(axis=-1) > 20).sum() > 20, name
    assert (np.ptp(page.picture(), axis=(0, 1)) <= 60).all(), "all layers are off: only the frame is left"
    page.click("show-cloud")
    assert ((page.picture().astype(int)[..., 2] - page.picture()[..., 0]) > 60).sum() > 200
    assert page.errors() == [] and page.requests() == []
