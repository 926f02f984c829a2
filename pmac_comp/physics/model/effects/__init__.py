"""The physical effects, one file each, each with one ``EFFECT``."""
