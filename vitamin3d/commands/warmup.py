# SPDX-License-Identifier: Apache-2.0
"""`vitamin3d warmup`: compiles the numerical kernels, once."""

import typer

from vitamin3d.commands.process import prepare


def warmup() -> None:
    """Compile all numerical kernels now (about a minute, once), so that no later run has to."""
    prepare()
    from vitamin3d.progress import warmed_up

    seconds = warmed_up()
    typer.echo(f"all kernels are compiled and cached ({seconds:.0f} s)")
