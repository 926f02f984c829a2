"""Keeps compiled code in step with the modules it was inlined from.

Numba renews cached machine code when the file of the function itself changes, not when a file it
calls into does. What lives here: the check that closes this gap. What may not: anything numeric.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any


def keep_fresh(function: Callable[..., Any], *modules: ModuleType) -> None:
    """Drop the cached machine code of a function that is older than a module it calls into.

    Parameters
    ----------
    function : Callable
        A cached ``njit`` function.
    modules : ModuleType
        Modules whose compiled functions it calls, directly or not.
    """
    cache = getattr(function, "_cache", None)
    folder = getattr(cache, "cache_path", None)
    if cache is None or folder is None:
        return  # compiled without a cache, or not compiled at all
    name = getattr(function, "__name__", "")
    indexes = list(Path(folder).glob(f"*.{name}-*.nbi"))
    sources = [Path(file) for module in modules if (file := module.__file__) is not None]
    newest = max((source.stat().st_mtime for source in sources if source.exists()), default=0.0)
    # Indexes of the function at its earlier lines stay behind and count for nothing.
    if indexes and max(index.stat().st_mtime for index in indexes) < newest:
        # Another process may be renewing it just now, or the cache may be read-only.
        with suppress(OSError):
            cache.flush()
