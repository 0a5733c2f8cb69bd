# SPDX-License-Identifier: Apache-2.0
"""Who runs which sequence: processes of this machine, or the workers of a dask cluster. A sequence whose process is lost is run again."""

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

from vitamin3d.benchmark.trial import BAD_INPUT, SequenceJob, run_sequence
from vitamin3d.errors import DependencyError, InputError, Vitamin3dError

ATTEMPTS = 3
"""How often a sequence is started before it is given up: finished trials are not run again."""
POLL_SECONDS = 0.2
Teller = Callable[[str], None]


def run_local(jobs: list[SequenceJob], workers: int, tell: Teller) -> dict[str, str]:
    """One process per sequence, at most `workers` at a time; name -> why it failed, for those that did."""
    waiting, running, failed = [(job, 1) for job in jobs], dict[str, tuple[SequenceJob, int, "subprocess.Popen[str]"]](), dict[str, str]()
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                job, attempt = waiting.pop(0)
                running[job.name] = job, attempt, _started(job)
            time.sleep(POLL_SECONDS)
            for name, (job, attempt, process) in list(running.items()):
                if process.poll() is None:
                    continue
                del running[name]
                reason = _reason(process)
                if process.returncode == 0:
                    tell(f"{name}: done")
                elif process.returncode != BAD_INPUT and attempt < ATTEMPTS:
                    tell(f"{name}: lost ({reason}); started again")
                    waiting.append((job, attempt + 1))
                else:
                    failed[name] = reason
    finally:
        for _, _, process in running.values():
            process.kill()
    return failed


def _started(job: SequenceJob) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "vitamin3d.benchmark.trial", json.dumps(asdict(job))]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def _reason(process: "subprocess.Popen[str]") -> str:
    told = process.stderr.read().strip() if process.stderr is not None else ""
    return told.splitlines()[-1] if told else f"ended with {process.returncode}"


def run_dask(jobs: list[SequenceJob], scheduler: str, workers: int, tell: Teller) -> dict[str, str]:
    """The same on a dask cluster, whose machines share the folder of the results.

    Args:
        scheduler: address, as `tcp://10.0.0.1:8786`; `local`: a cluster on this machine with so many workers.

    Raises:
        DependencyError: dask.distributed is not installed.
        InputError: nobody answers at the address.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise DependencyError("--scheduler needs dask.distributed: pip install 'vitamin3d[cluster]'") from None
    failed = {}
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(_client(Client, scheduler, workers))
        futures = {client.submit(run_sequence, job, key=f"vitamin3d {job.name}", pure=False, retries=ATTEMPTS - 1): job for job in jobs}
        for future in as_completed(futures):
            name, error = futures[future].name, future.exception()
            if error is None:
                tell(f"{name}: done")
            else:
                failed[name] = str(error).splitlines()[0] if str(error) else type(error).__name__
    return failed


@contextlib.contextmanager
def _client(client_class: Any, scheduler: str, workers: int) -> Iterator[Any]:
    with contextlib.ExitStack() as stack:
        address: Any = scheduler
        if scheduler == "local":
            from distributed import LocalCluster

            address = stack.enter_context(LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None))
        try:
            client = client_class(address, timeout="10s")
        except (OSError, ValueError) as error:
            raise InputError(f"--scheduler {scheduler}: nobody answers there ({type(error).__name__}); start `dask scheduler`") from None
        yield stack.enter_context(client)


def run_jobs(jobs: list[SequenceJob], scheduler: str | None, workers: int, tell: Teller) -> None:
    """Runs all; raises one error that names the sequences that failed, after the others are done."""
    failed = run_local(jobs, workers, tell) if scheduler is None else run_dask(jobs, scheduler, workers, tell)
    if failed:
        raise Vitamin3dError("; ".join(f"{name}: {reason.removeprefix(f'{name}: ')}" for name, reason in failed.items()))
