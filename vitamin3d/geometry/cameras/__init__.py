# SPDX-License-Identifier: Apache-2.0
"""Cameras: what everybody asks of one (`Camera`), and the models that there are."""

from vitamin3d.geometry.cameras.pinhole import PinholeCamera
from vitamin3d.geometry.cameras.protocol import Camera

__all__ = ["Camera", "PinholeCamera"]
