# SPDX-License-Identifier: Apache-2.0
"""The Geman–McClure kernel (Eq. 3), scaled so that small residuals cost r²: rho(r) = sigma² r² / (r² + sigma²).

Eq. 3 is rho / sigma²; the factor makes costs of different sigma comparable and changes no minimum.
"""

from vitamin3d._jit import inlined


@inlined
def geman_mcclure(squared_residual, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """rho(r), which saturates at sigma², and rho'(r) / (2 r), the weight of iteratively reweighted least squares, 1 at r = 0.

    Of r² in pixels² and 1 / sigma²; with 0 for the latter it is plain least squares.
    """
    k = 1.0 / (1.0 + squared_residual * inverse_squared_sigma)
    return squared_residual * k, k * k
