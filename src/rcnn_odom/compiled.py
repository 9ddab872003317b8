"""Functions compiled by numba, which are compiled only once on a machine where that is possible.

Numba keeps their machine code beside the source, or, where that cannot be written, in the user's folder for
caches, or in ``NUMBA_CACHE_DIR``. Where none of them can be written it refuses to load the function; here the
function is then compiled anew in every process.

Numba notices a change of the file in which a function is written, but not of the functions and constants that
it takes from other files: compiled functions must use those of their own file only.
"""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any], how: Callable[..., Any] = njit) -> Any:
    """Decorates a function that numba compiles when it is first called.

    Args:
        function: of numbers and arrays.
        how: ``numba.njit`` or ``numba.vectorize``.

    >>> @compiled
    ... def double(x):
    ...     return 2 * x
    >>> double(2)
    4
    """
    try:
        return how(cache=True)(function)
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        return how()(function)
