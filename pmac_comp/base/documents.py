"""Results as JSON documents: one form for what commands print and for what folders keep."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from enum import Enum
from typing import Any


def document(value: Any) -> str:
    """Text of one JSON document, indented, with a line end."""
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """Value as what JSON can hold; NaN and infinity become null, arrays become lists."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (str, int, bool, type(None))) and not isinstance(value, Enum):
        return value
    return _plain_object(value)


def _plain_object(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(plain(key)): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    for method, arguments in (("model_dump", {"mode": "json"}), ("tolist", {})):
        if hasattr(value, method):
            return plain(getattr(value, method)(**arguments))
    return str(value)
