# SPDX-License-Identifier: Apache-2.0
"""The old home of `vitamin3d.bundle_adjustment.subspace`, until the last caller has moved."""

from vitamin3d.bundle_adjustment.subspace import adjust_subspace

__all__ = ["adjust_subspace"]
