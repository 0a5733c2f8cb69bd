# SPDX-License-Identifier: Apache-2.0
"""The exceptions of vitamin3d: misuse and bad input. "Could not track" is a value, never one of these."""


class Vitamin3dError(Exception):
    """Base of all our exceptions. The command line prints its one-line message and exits with 2."""


class InputError(Vitamin3dError):
    """A source, calibration or option that cannot be used; the message names the file and the remedy."""


class OutputError(Vitamin3dError):
    """An output that cannot be written; the message names the path and the remedy."""


class DependencyError(Vitamin3dError):
    """An installed library does not do what it must; the message names it and the remedy."""


class WorkerError(Vitamin3dError):
    """A step of a run failed in a way nobody foresaw; the message names step and cause. The command line exits with 1."""
