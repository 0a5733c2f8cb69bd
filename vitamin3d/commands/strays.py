# SPDX-License-Identifier: Apache-2.0
"""Stray points of clouds and meshes, said before anything is measured with them."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import typer

from vitamin3d.errors import InputError

if TYPE_CHECKING:
    from vitamin3d.evaluation.comparison import Item


def say_strays(items: "Iterable[Item]", are_dropped: bool) -> None:
    """A warning for each file with stray points where they may be left out, else an error: one point at 2 km spoils every figure."""
    for item in items:
        if item.geometry.strays:
            what = f"{item.path}: {item.geometry.strays} points are not finite or far from all others"
            if not are_dropped:
                raise InputError(f"{what}; clean the cloud, or leave them out with --drop-strays")
            typer.echo(f"warning: {what}; left out", err=True)
