"""Compensation tables on the card: planned, uploaded, judged, brought to old or new."""
