"""Small numerical tools for compiled code."""

import numpy as np
from numba import njit


@njit(cache=True)
def quantile(values, n, share):  # type: ignore[no-untyped-def]
    """The value below which this share of values[:n] lies; they are shuffled (Hoare's selection)."""
    k = min(n - 1, int(share * n))
    low, high = 0, n - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return values[k]


@njit(cache=True)
def solve3(a, b):  # type: ignore[no-untyped-def]
    """The solution (3,) of a symmetric positive definite system, by Cholesky."""
    l00 = np.sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = np.sqrt(max(a[1, 1] - l10 * l10, 1e-300))
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(max(a[2, 2] - l20 * l20 - l21 * l21, 1e-300))
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    out = np.empty(3)
    out[2] = y2 / l22
    out[1] = (y1 - l21 * out[2]) / l11
    out[0] = (y0 - l10 * out[1] - l20 * out[2]) / l00
    return out
