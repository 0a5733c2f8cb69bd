# SPDX-License-Identifier: Apache-2.0
"""The command line, thin: options in, one job, exit codes out. Heavy imports wait until a command runs."""

import sys

import typer

from vitamin3d.commands.benchmark import benchmark
from vitamin3d.commands.compare import compare
from vitamin3d.commands.evaluate import evaluate
from vitamin3d.commands.figures import figures
from vitamin3d.commands.process import EXIT_BROKEN, EXIT_ERROR
from vitamin3d.commands.reconstruct import reconstruct, show_config
from vitamin3d.commands.warmup import warmup
from vitamin3d.errors import Vitamin3dError, WorkerError

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.callback()
def _vitamin3d() -> None:
    """From the pictures of one calibrated camera to a trajectory, a dense cloud and a mesh, on a CPU."""


app.command()(reconstruct)
app.command()(evaluate)
app.command()(compare)
app.command()(figures)
app.command()(benchmark)
app.command()(warmup)
app.command("config")(show_config)


@app.command()
def version() -> None:
    """Print the version."""
    from importlib.metadata import version as installed

    typer.echo(installed("vitamin3d"))


def main() -> None:
    """The console script: our errors become one line and exit code 2, a step that broke one line and 1."""
    try:
        app()
    except WorkerError as error:
        print(f"vitamin3d: {error} (what was reconstructed before is saved)", file=sys.stderr)
        sys.exit(EXIT_BROKEN)
    except Vitamin3dError as error:
        print(f"vitamin3d: {error}", file=sys.stderr)
        sys.exit(EXIT_ERROR)


if __name__ == "__main__":
    main()
