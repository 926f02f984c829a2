"""The table of fault ids: runs, failures and worst time, printed after ``pytest -m faults``."""

import re
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import pytest

_ID = re.compile(r"test_(f\d\d)(?!\d)", re.I)


@dataclass
class Row:
    """One fault id."""

    runs: int = 0
    failures: int = 0
    skipped: int = 0
    worst_s: float = 0.0


_rows: dict[str, Row] = defaultdict(Row)


@pytest.fixture
def count_runs(record_property: Callable[[str, object], None]) -> Callable[[int], None]:
    """Says how many injections a test made, for the table."""

    def count(n: int) -> None:
        record_property("fault_runs", n)

    return count


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    function = report.nodeid.rpartition("::")[2]
    match = _ID.search(function) or _ID.search(report.nodeid)
    if match is None or "tests/faults" not in report.nodeid:
        return
    row = _rows[match[1].upper()]
    if report.when == "call" and not report.skipped:
        row.runs += sum(int(n) for key, n in report.user_properties if key == "fault_runs") or 1
        row.worst_s = max(row.worst_s, report.duration)
    row.failures += report.failed
    row.skipped += report.skipped


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not _rows:
        return
    terminalreporter.section("faults")
    terminalreporter.write_line(f"{'id':<5}{'runs':>8}{'failures':>10}{'skipped':>9}{'worst s':>9}")
    for name, row in sorted(_rows.items()):
        terminalreporter.write_line(
            f"{name:<5}{row.runs:>8}{row.failures:>10}{row.skipped:>9}{row.worst_s:>9.2f}"
        )
