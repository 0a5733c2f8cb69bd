# SPDX-License-Identifier: Apache-2.0
"""The step of six variables from their normal equations, for kernels."""

import numpy as np

from vitamin3d._jit import kernel


@kernel
def solve_6x6(H, g, delta):  # type: ignore[no-untyped-def]
    """delta = -H⁻¹ g by Cholesky, H (1, 6, 6) given by its upper triangle and spoilt; False where it is not positive."""
    for i in range(6):
        for j in range(i, 6):
            total = H[0, i, j]
            for k in range(i):
                total -= H[0, k, i] * H[0, k, j]
            if i == j:
                if not total > 0.0:
                    return False
                H[0, i, i] = np.sqrt(total)
            else:
                H[0, i, j] = total / H[0, i, i]
    for i in range(6):
        total = -g[i]
        for k in range(i):
            total -= H[0, k, i] * delta[k]
        delta[i] = total / H[0, i, i]
    for i in range(5, -1, -1):
        total = delta[i]
        for k in range(i + 1, 6):
            total -= H[0, i, k] * delta[k]
        delta[i] = total / H[0, i, i]
    return True
