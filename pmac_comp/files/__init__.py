"""Capture files (HDF5, CSV, MAT), bench configs and model files. Imports ``base`` only."""
