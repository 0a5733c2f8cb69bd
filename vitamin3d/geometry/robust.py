# SPDX-License-Identifier: Apache-2.0
"""The Geman–McClure kernel (Eq. 3), scaled so that small residuals cost r²: rho(r) = sigma² r² / (r² + sigma²).

Eq. 3 is rho / sigma²; the factor makes costs of different sigma comparable and changes no minimum.
"""

from vitamin3d._jit import inlined


@inlined
def geman_mcclure_cost(squared_residual, squared_sigma):  # type: ignore[no-untyped-def]
    """rho(r) of r² and sigma², both in pixels²; saturates at sigma²."""
    return squared_sigma * squared_residual / (squared_residual + squared_sigma)


@inlined
def geman_mcclure_weight(squared_residual, squared_sigma):  # type: ignore[no-untyped-def]
    """rho'(r) / (2 r) = sigma⁴ / (r² + sigma²)², the weight of iteratively reweighted least squares; 1 at r = 0."""
    w = squared_sigma / (squared_residual + squared_sigma)
    return w * w


@inlined
def geman_mcclure(squared_residual, inverse_squared_sigma):  # type: ignore[no-untyped-def]
    """Cost and weight of r² with one division; 0 for 1 / sigma² is plain least squares."""
    k = 1.0 / (1.0 + squared_residual * inverse_squared_sigma)
    return squared_residual * k, k * k
