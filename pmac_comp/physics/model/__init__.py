"""Parameters, effects, assembly, compiled kernel and quasi-static closed forms."""
