"""Typer commands: parse, call workflow, render. No logic, no numbers."""
