"""Command line: parse, call ``workflow``, render. No logic, no numbers."""
