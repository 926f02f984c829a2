"""Compensation in SI: dynamic law, lead table, pre-compensated trajectory, limits. No counts."""
