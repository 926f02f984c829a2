"""Data gathering at the servo rate: planned, taken, checked, and on the disk while it lasts."""
