# SPDX-License-Identifier: Apache-2.0
"""Speed of the NLTGV kernel: iterations per CPU second on a mesh of so many vertices, one thread.

python tools/benchmark_nltgv.py --vertices 10000 --iterations 2000
"""

import argparse
import sys
import time

import numpy as np
from scipy.spatial import Delaunay

from vitamin3d.config import NltgvConfig
from vitamin3d.dense.delaunay import unique_edges
from vitamin3d.dense.nltgv import normalized_problem, objective, solve
from vitamin3d.types import ImageMesh

WIDTH, HEIGHT, NOISE = 752, 480, 0.02


def noisy_plane(count: int) -> ImageMesh:
    """A mesh of random pixels, row by row as `triangulate` orders them, and the inverse depths of a plane with noise."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, [WIDTH, HEIGHT], (count, 2))
    pixels = pixels[np.lexsort((pixels[:, 0], pixels[:, 1] // 32))]
    triangles = Delaunay(pixels).simplices.astype(np.int32)
    inverse_depth = (0.3 + pixels @ np.array([1e-4, 2e-4])) * (1 + NOISE * rng.standard_normal(count))
    return ImageMesh(pixels, triangles, unique_edges(triangles), inverse_depth, np.full(count, NOISE))


def main(argv: list[str] | None = None) -> int:
    """Measures and prints one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=10_000)
    parser.add_argument("--iterations", type=int, default=2000)
    arguments = parser.parse_args(argv)
    mesh = noisy_plane(max(100, arguments.vertices))
    problem = normalized_problem(mesh, NltgvConfig())
    start = np.column_stack([problem.data, np.zeros((len(problem.data), 2))])
    solve(problem, start, 1)
    before = time.process_time()
    state = solve(problem, start, arguments.iterations)
    rate = arguments.iterations / (time.process_time() - before)
    energies = objective(problem, start), objective(problem, state)
    size = f"{len(mesh.pixels)} vertices, {len(mesh.edges)} edges"
    print(f"{size}: {rate:.0f} iterations per CPU second, energy {energies[0]:.4g} to {energies[1]:.4g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
