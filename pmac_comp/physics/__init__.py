"""The drive: pure numerics in SI, no I/O; knows no PMAC."""
