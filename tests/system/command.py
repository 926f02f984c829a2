"""``pmac-comp`` in a process of its own, as a user starts it."""

import subprocess
import sys
from pathlib import Path


def run(
    *words: str, cwd: Path | None = None, said: str = "", timeout_s: float = 300.0
) -> subprocess.CompletedProcess[str]:
    """The ended command, with what it printed; ``said`` is its standard input."""
    return subprocess.run(
        [sys.executable, "-m", "pmac_comp", *words],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=timeout_s,
        check=False,
        input=said,
    )
