"""Errors, units, arrays, clock, atomic files, documents, progress. Imports nothing of ours."""
