# SPDX-License-Identifier: Apache-2.0
"""Outlying points of clouds and meshes, said before anything is measured with them."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import typer

from vitamin3d.errors import InputError

if TYPE_CHECKING:
    from vitamin3d.evaluation.comparison import Item


def report_outliers(items: "Iterable[Item]", are_dropped: bool) -> None:
    """A warning for each file with outlying points where they may be left out, else an error: one point at 2 km spoils every figure."""
    for item in items:
        if item.geometry.outliers:
            what = f"{item.path}: {item.geometry.outliers} points are not finite or far from all others"
            if not are_dropped:
                raise InputError(f"{what}; clean the cloud, or leave them out with --drop-outliers")
            typer.echo(f"warning: {what}; left out", err=True)
