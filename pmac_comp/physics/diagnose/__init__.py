"""Residual localisation, hypotheses, growth loop and verdict."""
