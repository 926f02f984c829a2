"""Model-based compensation of ball-screw axes on a Delta Tau Turbo PMAC2.

The two towers (``physics`` and ``machine``) never import each other; ``workflow`` is the bridge.
See README.md, "Where does a line go?".
"""

__version__ = "0.1.0"
