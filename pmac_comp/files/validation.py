"""What is wrong with a file, in words: where, what was found, and the nearest key that exists."""

import difflib
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError


def problems(error: ValidationError, root: type[BaseModel]) -> list[str]:
    """One line for each problem that pydantic found in a file.

    Parameters
    ----------
    error : ValidationError
        From validating the file's contents.
    root : type of BaseModel
        Model of the whole file, for the keys that it knows.
    """
    return [_explain(item, root) for item in error.errors()]


def _explain(item: Any, root: type[BaseModel]) -> str:
    location = [str(part) for part in item["loc"]]
    where = ".".join(location)
    if not where:
        return str(item["msg"])
    if item["type"] == "extra_forbidden":
        return f"unknown key '{where}'{_nearest(location, root)}"
    if item["type"] == "missing":
        return f"missing key '{where}'"
    message, found = str(item["msg"]).removeprefix("Value error, "), item.get("input")
    # Of a table that does not fit together, the message says what; its contents would bury that.
    got = "" if isinstance(found, Mapping) else f" (got {found!r})"
    return f"'{where}': {message}{got}"


def _nearest(location: list[str], root: type[BaseModel]) -> str:
    known = _keys_of(location[:-1], root)
    close = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
    if close:
        return f"; the nearest known key is '{close[0]}'"
    return f"; known keys here: {', '.join(sorted(known))}" if known else ""


def _keys_of(table: list[str], root: type[BaseModel]) -> list[str]:
    model: Any = root
    for part in table:
        field = model.model_fields.get(part)
        if field is None:
            return []
        kinds = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        if not models:
            return []
        model = models[0]
    # What is not written in a file is filled in by the reader.
    return [key for key, field in model.model_fields.items() if field.repr]
