"""Threads for simulations, which run side by side as their kernels release the interpreter lock."""

import os
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager


@contextmanager
def working(executor: Executor | None = None) -> Iterator[Executor]:
    """The executor that was handed in, or one thread per core."""
    if executor is not None:
        yield executor
        return
    with ThreadPoolExecutor(max_workers=os.cpu_count() or 2) as own:
        yield own
