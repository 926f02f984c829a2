"""Figures and self-contained HTML pages. No numbers are computed here."""
