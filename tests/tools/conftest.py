# SPDX-License-Identifier: Apache-2.0
"""The tools by their names, and a run for those that export from one."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from vitamin3d.dense.surface_extraction import vertex_normals
from vitamin3d.exporters.mesh import write_ply
from vitamin3d.types import Surface

TOOLS = Path(__file__).parents[2] / "tools"
SIDE = 41


@pytest.fixture(scope="module")
def tool():
    """A tool by its name, loaded once."""
    loaded = {}

    def load(name):
        if name not in loaded:
            spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
            loaded[name] = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
            spec.loader.exec_module(loaded[name])
        return loaded[name]

    yield load
    for name in loaded:
        del sys.modules[name]


@pytest.fixture
def run(tmp_path):
    """A finished run: a bumpy square of SIDE × SIDE vertices before three cameras."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE))
    vertices = np.column_stack([x.ravel(), y.ravel(), 2 + 0.05 * np.sin(5 * x.ravel())])
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    triangles = np.vstack([np.stack([corner, corner + SIDE, corner + 1], 1), np.stack([corner + 1, corner + SIDE, corner + SIDE + 1], 1)])
    colors = np.tile(np.array([[200, 100, 50]], np.uint8), (len(vertices), 1))
    surface = Surface(vertices, triangles.astype(np.int32), vertex_normals(vertices, triangles), colors)
    for name in ("mesh_high.ply", "mesh_low.ply"):
        write_ply(surface, tmp_path / name, ["lengths in metres"])
    (tmp_path / "keyframes.tum").write_text("".join(f"{k}.000000001 0 0 {0.1 * k} 0 0 0 1\n" for k in range(1, 4)))
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "canvas.yaml").write_text(
        "camera_model: pinhole\nintrinsics: [60.0, 60.0, 39.5, 29.5]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\nresolution: [80, 60]\n"
    )
    return tmp_path
