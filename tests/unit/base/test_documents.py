"""What JSON cannot hold becomes what it can."""

import json
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from pmac_comp.base.documents import document


def test_values_become_plain_and_json_holds_no_nan() -> None:
    class Colour(Enum):
        RED = "red"

    @dataclass
    class Thing:
        at: Path
        colour: Colour

    value = {"a": np.array([1.0, np.nan]), "b": Thing(Path("x"), Colour.RED), "c": (np.int64(3),)}
    text = document(value)
    assert json.loads(text) == {"a": [1.0, None], "b": {"at": "x", "colour": "red"}, "c": [3]}
