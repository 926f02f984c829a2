"""Trajectories, filters, spectra and metrics."""
