"""The whole state of a simulated card, object by object: taken, put back, compared."""

import functools
import hashlib
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import PurePath
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

_PLAIN = (type(None), bool, int, float, str, bytes)
_NAMED = (type, ModuleType, Enum, PurePath, np.generic, BuiltinFunctionType)


class SavedState:
    """All that can be reached from some objects, to be put back in place.

    References from outside stay valid: the same objects hold again what they held.
    """

    def __init__(self, *roots: object) -> None:
        self._undo = [undo for item in reachable(*roots) for undo in _undo(item)]

    def put_back(self) -> None:
        """Everything as it was taken."""
        for undo in self._undo:
            undo()


def digest(*roots: object) -> str:
    """Of all that can be reached, values and which object is which."""
    out = hashlib.blake2b()
    numbers: dict[int, int] = {}
    for item in reachable(*roots):
        numbers[id(item)] = len(numbers)
    for item in reachable(*roots):
        held = _held(item)
        out.update(type(item).__qualname__.encode())
        if isinstance(held, bytes):
            out.update(held)
            continue
        for part in held:
            plain = isinstance(part, _PLAIN)
            out.update(repr(part if plain else numbers[id(part)]).encode() + b";")
    return out.hexdigest()


def reachable(*roots: object) -> Iterator[object]:
    """Every object once, in an order that depends on the contents alone."""
    seen: set[int] = set()
    stack = list(roots)
    kept: list[object] = []  # an id must not be used again meanwhile
    while stack:
        item = stack.pop()
        if isinstance(item, _PLAIN) or id(item) in seen:
            continue
        seen.add(id(item))
        kept.append(item)
        yield item
        held = _held(item)
        if not isinstance(held, bytes):
            stack += held


def _held(item: object) -> bytes | list[Any]:
    """What an object holds: bytes, or other objects; unknown kinds raise TypeError."""
    for kind, held in _CONTENTS:
        if isinstance(item, kind):
            return held(item)
    return [part for pair in _attributes(item).items() for part in pair]


def _of_function(item: FunctionType) -> list[Any]:
    cells = [cell.cell_contents for cell in item.__closure__ or ()]
    return [item.__qualname__, *cells, *(item.__defaults__ or ())]


_CONTENTS: tuple[tuple[Any, Callable[[Any], bytes | list[Any]]], ...] = (
    (dict, lambda d: [*d.keys(), *d.values()]),
    ((list, tuple, deque), list),
    (np.ndarray, lambda a: a.tobytes()),
    (_NAMED, lambda n: repr(n).encode()),
    ((set, frozenset), lambda s: sorted(s, key=repr)),
    (bytearray, bytes),
    (MethodType, lambda m: [m.__self__, m.__func__.__qualname__]),
    (FunctionType, _of_function),
    (functools.partial, lambda p: [p.func, p.args, p.keywords]),
)


def _attributes(item: object) -> dict[str, Any]:
    slots = {
        name: getattr(item, name)
        for owner in type(item).__mro__
        for name in owner.__dict__.get("__slots__", ())
        if name not in {"__dict__", "__weakref__"} and hasattr(item, name)
    }
    named = getattr(item, "__dict__", None)
    if named is None and not slots:
        raise TypeError(f"{type(item)} has contents that cannot be seen")
    return {**(named or {}), **slots}


def _undo(item: object) -> list[Callable[[], object]]:
    """What puts an object back; nothing for one that cannot change."""
    if isinstance(item, np.ndarray):
        return [functools.partial(np.copyto, item, item.copy())] if item.flags.writeable else []
    if isinstance(item, (bytearray, list)):
        return [functools.partial(item.__setitem__, slice(None), item[:])]
    if isinstance(item, (dict, set)):
        return [item.clear, functools.partial(item.update, item.copy())]
    if isinstance(item, deque):
        return [item.clear, functools.partial(item.extend, item.copy())]
    if isinstance(item, (*_NAMED, tuple, frozenset, MethodType, FunctionType, functools.partial)):
        return []
    named = getattr(item, "__dict__", {})
    undo: list[Callable[[], object]] = []
    if named:
        undo = [named.clear, functools.partial(named.update, named.copy())]
    slots = {name: value for name, value in _attributes(item).items() if name not in named}
    return undo + [
        functools.partial(object.__setattr__, item, name, value) for name, value in slots.items()
    ]
