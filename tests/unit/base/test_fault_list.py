"""The list of faults that a test run prints has a line for each fault that tests inject."""

import re
from pathlib import Path

from tests.fault_table import FAULTS

TESTS = Path(__file__).resolve().parents[2]


def test_every_fault_that_is_injected_is_in_the_list_and_none_beside() -> None:
    texts = [path.read_text(encoding="utf-8") for path in sorted(TESTS.rglob("test_*.py"))]
    named = {
        f"F{number}"
        for text in texts
        for ids in re.findall(r"def test((?:_f\d\d)+)_", text)
        for number in re.findall(r"\d\d", ids)
    }
    named |= {match[1] for text in texts if (match := re.match(r'"""(F\d\d)', text))}
    assert named == set(FAULTS)
