"""Machine code in the cache must not be older than the code it was made from."""

import importlib.util
import os
import sys
import time

import pytest

from pmac_comp.simulator.servo.compiled import keep_fresh

INNER = "from numba import njit\n@njit(cache=True)\ndef inner():\n    return {value}\n"
OUTER = (
    "from numba import njit\nfrom inner_for_test import inner\n"
    "@njit(cache=True)\ndef outer():\n    return inner() + 1\n"
)


def load(folder, name):
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield tmp_path
    for name in ("inner_for_test", "outer_for_test"):
        sys.modules.pop(name, None)


def write(folder, value, age_s):
    path = folder / "inner_for_test.py"
    path.write_text(INNER.format(value=value))
    os.utime(path, (time.time() - age_s,) * 2)


def test_a_changed_callee_renews_its_callers(folder):
    (folder / "outer_for_test.py").write_text(OUTER)
    os.utime(folder / "outer_for_test.py", (time.time() - 100,) * 2)
    write(folder, 10, 100)
    inner, outer = load(folder, "inner_for_test"), load(folder, "outer_for_test")
    keep_fresh(outer.outer, inner)
    assert outer.outer() == 11

    inner, outer = load(folder, "inner_for_test"), load(folder, "outer_for_test")
    keep_fresh(outer.outer, inner)
    assert outer.outer() == 11
    assert sum(outer.outer.stats.cache_hits.values()) == 1

    write(folder, 20, -2)
    inner, outer = load(folder, "inner_for_test"), load(folder, "outer_for_test")
    keep_fresh(outer.outer, inner)
    assert outer.outer() == 21
