"""The list of faults, and the table of them after a test run: injections, failures, worst time.

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

FAULTS = {
    "F01": "the connection is cut anywhere in a change",
    "F02": "a cut that loses answers under way too",
    "F03": "answers split or glued",
    "F04": "an answer that begins and does not end",
    "F05": "an answer that comes after its deadline",
    "F06": "stray text before an answer",
    "F07": "half-closed, reset or dead connections",
    "F08": "a slow peer",
    "F09": "no host, no port, or no PMAC behind it",
    "F10": "a noisy serial line",
    "F11": "a flipped bit in a download",
    "F12": "dialog modes that another client changed",
    "F13": "an SSH host that is not known, or another",
    "F14": "shells behind SSH that say more, or less",
    "F15": "a line that the card refuses",
    "F16": "a line that is lost or doubled without an error",
    "F17": "another client that changes the card meanwhile",
    "F18": "a change left half-made, enabled by others",
    "F19": "two of us at one card",
    "F20": "the card is reset amid a change",
    "F21": "a SAVE that fails, a damaged flash",
    "F22": "an axis that begins to move amid a change",
    "F23": "a jump when tables are switched on",
    "F24": "a motor that trips during a run",
    "F25": "encoder and scale that disagree",
    "F26": "another card, or one without what is needed",
    "F27": "a full disk during a capture",
    "F28": "a kill during a capture",
    "F29": "a kill during a change or a measurement",
    "F30": "Ctrl-C and requests to stop",
    "F31": "a gather buffer that overflows",
    "F32": "samples that are missing or repeated",
    "F33": "counters that wrap around",
    "F34": "numbers that are none, or of no size",
    "F35": "tables beyond limits or ranges",
    "F36": "numbers and journals that read as something else",
    "F37": "clocks that jump",
    "F38": "folders and disks that take nothing",
    "F40": "captures too poor to identify from",
    "F41": "malformed requests to the simulated card",
    "F42": "clients without end to the simulated card",
    "F43": "programs without end on the simulated card",
    "F44": "a controller that means harm",
    "F45": "passwords that are repeated",
    "F46": "keys that are offered unasked",
}
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
        f"{'id':<5}{'places':>8}{'runs':>8}{'failures':>10}{'skipped':>9}{'worst s':>9}  fault"
    )
    for name, row in sorted(_rows.items()):
        terminalreporter.write_line(
            f"{name:<5}{row.places:>8}{row.runs:>8}{row.failures:>10}{row.skipped:>9}"
            f"{row.worst_s:>9.2f}  {FAULTS.get(name, '')}"
        )
