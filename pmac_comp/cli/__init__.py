"""Command line: parse, call ``workflow``, render. No logic, no numbers."""

import os

# Runs are simulated on all cores at once; linear algebra that starts threads of its own beside
# them costs a fifth more time. Must stand before the first import of numpy; a user's value holds.
for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
