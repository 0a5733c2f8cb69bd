# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment (Eq. 6) of cameras, points and observations, wherever they come from."""
