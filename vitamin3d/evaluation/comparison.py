# SPDX-License-Identifier: Apache-2.0
"""Our run beside what other systems made of the same place: all in one world, then counted, measured and drawn."""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vitamin3d.datasets.point_files import SUFFIXES, Geometry, read_geometry
from vitamin3d.datasets.trajectory_files import read_trajectory
from vitamin3d.errors import InputError
from vitamin3d.evaluation.cloud_statistics import coverage_of_truth, coverage_of_voxels, density, mutual
from vitamin3d.evaluation.finished_run import Run, Truth
from vitamin3d.evaluation.registration import register
from vitamin3d.evaluation.run_evaluation import pair
from vitamin3d.evaluation.surface_error import refined, sample_surface, surface_errors
from vitamin3d.evaluation.trajectory_error import Alignment, absolute_errors, alignment_between, summarize
from vitamin3d.types import Array, Trajectory

TRAJECTORIES = ("trajectory.tum", "CameraTrajectory.txt", "f_kf.txt", "f.txt", "KeyFrameTrajectory.txt", "trajectory.txt", "keyframes.tum")
CLOUDS = ("points.ply", "cloud.ply", "fused.ply", "MapPoints.txt", "map.pcd", "points.pcd", "mesh.ply", "cloud.pcd", "points.xyz")
OWN = (("cloud", "cloud.ply"), ("mesh", "mesh_high.ply"))
SAMPLES_FOR_REGISTRATION = 20_000


@dataclass(frozen=True)
class Item:
    """A cloud or mesh of somebody, and the trajectory that puts it into the world."""

    name: str
    path: Path
    geometry: Geometry
    trajectory: Trajectory | None = None
    trajectory_file: Path | None = None


@dataclass(frozen=True)
class Placement:
    """How an item came into the common world."""

    how: str
    """`trajectory`, `registration`, `itself` (it is the world), or `none`: nothing was found."""
    scale: float
    R: Array
    t: Array
    figures: dict[str, Any] = field(default_factory=dict)
    """What says how well: matched poses and ATE, or overlap and median distance."""

    def apply(self, points: Array) -> Array:
        """Points (N, 3) of the item in the world."""
        return np.asarray(self.scale * points @ self.R.T + self.t)


ITSELF = Placement("itself", 1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Placed:
    """An item in the common world."""

    item: Item
    placement: Placement
    geometry: Geometry
    samples: Array
    """(N, 3) points that stand for it."""


def read_own(run: Path) -> list[Item]:
    """The cloud and the fine mesh of a finished run; InputError where it has neither."""
    file = run / "trajectory.tum"
    trajectory = read_trajectory(file).trajectory if run.is_dir() else None
    items = [Item(f"ours: {kind}", run / name, read_geometry(run / name), trajectory, file) for kind, name in OWN if (run / name).is_file()]
    if not items:
        raise InputError(f"{run}: neither cloud.ply nor mesh_high.ply; give the folder of a finished run")
    return [item for item in items if len(item.geometry.points)]


def read_geometry_as(name: str, path: Path) -> Item:
    """A cloud or mesh that needs no placing."""
    return Item(name, path, read_geometry(path))


def read_other(spec: str) -> Item:
    """An item of another system.

    Args:
        spec: a folder with a trajectory and a cloud under their usual names, a cloud or mesh, or `CLOUD,TRAJECTORY`.
    """
    if "," in spec and not Path(spec).exists():
        first, second = (_existing(Path(part)) for part in spec.split(",", 1))
        return Item(_name(first), first, read_geometry(first), read_trajectory(second).trajectory, second)
    path = _existing(Path(spec))
    if path.is_file():
        return Item(_name(path), path, read_geometry(path))
    cloud, trajectory = _first(path, CLOUDS), _first(path, TRAJECTORIES)
    if cloud is None:
        others = [p for p in sorted(path.iterdir()) if p.suffix.lower() in SUFFIXES and p != trajectory]
        if len(others) != 1:
            raise InputError(f"{path}: no cloud under a usual name ({', '.join(CLOUDS[:4])}, ...); give the file")
        cloud = others[0]
    return Item(
        _name(path), cloud, read_geometry(cloud), None if trajectory is None else read_trajectory(trajectory).trajectory, trajectory
    )


def _existing(path: Path) -> Path:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    return path


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _name(path: Path) -> str:
    """Last two parts of a path: `orbslam3/kitchen`."""
    return "/".join(path.resolve().parts[-2:])


def compare(own: list[Item], others: list[Item], truth: Truth | None, reference: Array | None) -> tuple[dict[str, Any], list[Placed]]:
    """Places and measures all items.

    Args:
        truth: of the trajectories; its world and unit become the common ones. None: those of our run.
        reference: (M, 3) points of the true surface in the truth's world, or None.

    Raises:
        InputError: our own run cannot be placed.
    """
    placed = placed_together(own, others, truth, reference)
    ours = placed[len(own) - 1].samples
    reports = [_measured(p, ours, reference, is_own=k < len(own)) for k, p in enumerate(placed)]
    return {"world": "ground truth" if truth is not None else "our run", "items": reports}, placed


def placed_together(own: list[Item], others: list[Item], truth: Truth | None, reference: Array | None) -> list[Placed]:
    """All items in one world, ours first; see `compare`."""
    world = truth.trajectory if truth is not None else own[0].trajectory
    placed = [place(item, by_trajectory(item, truth, world), reference) for item in own]
    for item in others:
        placement = (
            by_trajectory(item, truth, world)
            if item.trajectory is not None and world is not None
            else _by_registration(item, placed[: len(own)])
        )
        placed.append(place(item, placement, reference))
    return placed


def by_trajectory(item: Item, truth: Truth | None, world: Trajectory | None) -> Placement:
    """By the similarity between the item's trajectory and the truth's, or our run's."""
    if item.trajectory is None or world is None or (truth is None and item.trajectory is world):
        return ITSELF
    target = truth if truth is not None else Truth(world, "our run")
    paired = pair(Run(item.trajectory_file or item.path, item.trajectory, {}), target)
    s, R, t = alignment_between(paired.estimate, paired.truth, Alignment.SIM3)
    errors = summarize(absolute_errors(paired.estimate, paired.truth, Alignment.SIM3))
    return Placement("trajectory", s, R, t, {"matched_poses": errors.count, "ate_rmse": errors.rmse})


def _by_registration(item: Item, own: list[Placed]) -> Placement:
    """By its shape, onto our cloud, or where that fails onto our mesh: sparse maps resemble each other most."""
    samples = sample_surface(item.geometry, SAMPLES_FOR_REGISTRATION)
    for ours in own:
        found = register(samples, thinned_to(ours.samples, SAMPLES_FOR_REGISTRATION))
        figures = {"overlap": found.overlap, "median_distance": found.median_distance}
        placement = Placement("registration" if found.holds else "none", found.scale, found.R, found.t, figures)
        if found.holds:
            break
    return placement


def thinned_to(points: Array, count: int) -> Array:
    """At most `count` of the points, drawn evenly, always the same."""
    return points if len(points) <= count else points[np.random.default_rng(0).choice(len(points), count, replace=False)]


def place(item: Item, placement: Placement, reference: Array | None) -> Placed:
    """The item in the world; refined by the true surface (M, 3) where one is given."""
    samples = placement.apply(sample_surface(item.geometry))
    if reference is not None and placement.how != "none":
        samples, (s, R, t) = refined(samples, reference)
        placement = replace(placement, scale=s * placement.scale, R=R @ placement.R, t=s * R @ placement.t + t)
    return Placed(item, placement, replace(item.geometry, points=placement.apply(item.geometry.points)), samples)


def _measured(placed: Placed, ours: Array, reference: Array | None, is_own: bool) -> dict[str, Any]:
    item, placement = placed.item, placed.placement
    report: dict[str, Any] = {
        "name": item.name,
        "file": str(item.path),
        "kind": "mesh" if item.geometry.is_mesh else "cloud",
        "points": len(item.geometry.points),
        "triangles": len(item.geometry.triangles),
        "outliers": item.geometry.outliers,
        "placed_by": placement.how,
        "scale": placement.scale,
        **placement.figures,
    }
    if placement.how == "none":
        return report
    report["density"] = asdict(density(placed.geometry, placed.samples))
    if reference is not None:
        report["truth"] = asdict(surface_errors(placed.samples, reference))
    if not is_own:
        report["mutual"] = asdict(mutual(placed.samples, ours))
        both = placed.samples, ours
        report["coverage"] = asdict(coverage_of_voxels(*both) if reference is None else coverage_of_truth(*both, reference))
    return report
