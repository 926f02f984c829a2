"""The table of fault ids after a test run: injections, failures and worst time of each id.

Where a test proves that many places (bytes, mostly) leave the same and injects at one of them,
the table tells both numbers.

A test belongs to the id in its own name, else to the one its mark or its module names. The table
is printed whenever a test of the list ran; ``pytest -m faults`` runs exactly those.
"""

import random
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import pytest

_IN_FUNCTION = re.compile(r"test_(f\d\d)(?!\d)", re.I)
_IN_DOC = re.compile(r"^F\d\d(?!\d)")


@dataclass
class Row:
    """One fault id."""

    runs: int = 0
    places: int = 0
    failures: int = 0
    skipped: int = 0
    worst_s: float = 0.0


_rows: dict[str, Row] = defaultdict(Row)
_share = 1.0
T = TypeVar("T")


def set_share(share: float) -> None:
    """How much of each exhaustive list runs; see ``pytest --share``."""
    global _share  # noqa: PLW0603 - an option of the whole run
    _share = share


def all_of(points: Sequence[T]) -> Sequence[T]:
    """An exhaustive list, or the random share of it that was asked for, seed fixed."""
    if _share >= 1.0:
        return points
    n = min(len(points), max(2, round(_share * len(points))))
    chosen = sorted(random.Random(2026).sample(range(len(points)), n))
    return [points[k] for k in chosen]


@pytest.fixture
def count_runs(record_property: Callable[[str, object], None]) -> Callable[[int], None]:
    """Says how many injections a test made, for the table."""

    def count(n: int) -> None:
        record_property("fault_runs", n)

    return count


@pytest.fixture
def count_places(record_property: Callable[[str, object], None]) -> Callable[[int], None]:
    """Says for how many places the injections of a test stand, if not for one each."""

    def count(n: int) -> None:
        record_property("fault_places", n)

    return count


def _id_of(item: pytest.Item) -> str | None:
    match = _IN_FUNCTION.search(item.name)
    if match:
        return match[1].upper()
    if item.get_closest_marker("faults") is None:
        return None
    document = getattr(getattr(item, "module", None), "__doc__", None) or ""
    found = _IN_DOC.match(document)
    return found[0] if found else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Note the id, and how many examples a property test draws."""
    report: pytest.TestReport = yield  # type: ignore[misc, assignment]
    fault = _id_of(item)
    if fault is not None:
        report.user_properties.append(("fault_id", fault))
        chosen = getattr(getattr(item, "obj", None), "_hypothesis_internal_use_settings", None)
        if chosen is not None and report.when == "call":
            report.user_properties.append(("fault_runs", chosen.max_examples))
    return report  # type: ignore[return-value]


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add a finished test to the row of its id."""
    properties = [(key, value) for key, value in report.user_properties]
    fault = next((str(value) for key, value in properties if key == "fault_id"), None)
    if fault is None:
        return
    row = _rows[fault]
    if report.when == "call" and not report.skipped:
        runs = _sum(properties, "fault_runs") or 1
        row.runs += runs
        row.places += _sum(properties, "fault_places") or runs
        row.worst_s = max(row.worst_s, report.duration)
    row.failures += report.failed
    row.skipped += report.skipped


def _sum(properties: list[tuple[str, object]], name: str) -> int:
    return sum(int(str(n)) for key, n in properties if key == name)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the table."""
    if not _rows:
        return
    terminalreporter.section("faults")
    terminalreporter.write_line(
        f"{'id':<5}{'places':>8}{'runs':>8}{'failures':>10}{'skipped':>9}{'worst s':>9}"
    )
    for name, row in sorted(_rows.items()):
        terminalreporter.write_line(
            f"{name:<5}{row.places:>8}{row.runs:>8}{row.failures:>10}{row.skipped:>9}"
            f"{row.worst_s:>9.2f}"
        )
