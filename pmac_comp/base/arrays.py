"""Array types, stretches of samples, and the check that keeps NaN and infinity out of results."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmac_comp.base.errors import ModelError, NonFinite

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def stretches(chosen: BoolArray) -> tuple[slice, ...]:
    """Stretches of consecutive chosen samples of an array, shape (n,), in order."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], chosen, [False]))))
    return tuple(slice(int(a), int(b)) for a, b in edges.reshape(-1, 2))


def finite_array(name: str, value: Iterable[Any] | Any, *, min_size: int = 1) -> FloatArray:
    """Value as a finite 1-D float64 array.

    Parameters
    ----------
    name : str
        What the array is, for the error text.
    value : array_like, shape (n,)
        Anything numpy turns into real numbers.
    min_size : int
        Least number of samples.

    Returns
    -------
    ndarray, shape (n,)
        Contiguous float64 copy or view.

    Raises
    ------
    ModelError
        Not one-dimensional, not real numbers or too short.
    NonFinite
        NaN or infinity, with the index of the first.
    """
    raw = np.asarray(value)
    if raw.dtype.kind not in "fiub":
        raise ModelError(
            f"{name} holds {raw.dtype} values, not real numbers.",
            code="PC-ARR-001",
            hint="Give a one-dimensional array of real numbers.",
        )
    if raw.ndim != 1 or raw.size < min_size:
        raise ModelError(
            f"{name} has shape {raw.shape}; one dimension of at least {min_size} is needed.",
            code="PC-ARR-002",
            hint="Give a one-dimensional array with enough samples.",
        )
    array = np.ascontiguousarray(raw, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise NonFinite(
            f"{name} holds {array[bad[0]]} at index {int(bad[0])} ({bad.size} such samples).",
            code="PC-ARR-003",
            hint="Remove or mark the samples as invalid before using them.",
            context={"index": int(bad[0]), "count": int(bad.size)},
        )
    return array
