"""Model-based compensation of ball-screw axes on a Delta Tau Turbo PMAC2.

The two towers (``physics`` and ``machine``) never import each other; ``workflow`` is the bridge.
See README.md, "The house: two towers and one bridge".
"""

__version__ = "0.1.0"


def _give_numba_a_cache() -> None:
    """Point numba to a private folder where neither the package nor the home can be written."""
    import os
    import tempfile
    from pathlib import Path

    writable = (Path(__file__).parent, Path.home())
    if "NUMBA_CACHE_DIR" not in os.environ and not any(os.access(p, os.W_OK) for p in writable):
        os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="pmac_comp-")


_give_numba_a_cache()
