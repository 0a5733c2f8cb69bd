# SPDX-License-Identifier: Apache-2.0
"""Hill climbing of the curvature, drawn towards a prediction (Eq. 5)."""

from vitamin3d._jit import inlined


@inlined
def climb(kappa, u, v, predicted_u, predicted_v, weight, squared_sigma, max_steps):  # type: ignore[no-untyped-def]
    """Hill climbing over eight neighbours of F (Eq. 5) from pixel (u, v); the last pixel and whether it is a maximum."""
    height, width = kappa.shape
    best = kappa[v, u] + weight * squared_sigma / ((u - predicted_u) ** 2 + (v - predicted_v) ** 2 + squared_sigma)
    for _ in range(max_steps + 1):
        best_u, best_v = u, v
        for n in range(v - 1, v + 2):
            for m in range(u - 1, u + 2):
                if kappa[n, m] + weight > best:  # no w is above 1: saves most of the divisions
                    value = kappa[n, m] + weight * squared_sigma / ((m - predicted_u) ** 2 + (n - predicted_v) ** 2 + squared_sigma)
                    if value > best:
                        best, best_u, best_v = value, m, n
        if best_u == u and best_v == v:
            return u, v, True
        u, v = best_u, best_v
        if u < 1 or v < 1 or u >= width - 1 or v >= height - 1:
            return u, v, False
    return u, v, False
