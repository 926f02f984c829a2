"""Errors, units, arrays, clock, atomic files. Imports nothing of ours."""
