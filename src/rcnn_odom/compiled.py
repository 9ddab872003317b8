"""Functions that numba compiles only once on a machine, if the machine code can be stored.

Numba stores the machine code beside the source. If it cannot write there, it uses the user's cache folder or
``NUMBA_CACHE_DIR``. If it cannot write to any of them, it refuses to load the function; here the function is
then compiled again in every process.

Numba notices a change of the file that contains a function, but not a change of functions and constants that
the function takes from other files. A compiled function must therefore use only those of its own file.
"""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any], how: Callable[..., Any] = njit) -> Any:
    """Decorator: numba compiles the function at its first call.

    Args:
        function: takes numbers and arrays.
        how: numba's decorator, ``numba.njit`` or ``numba.vectorize``.

    Example:
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
