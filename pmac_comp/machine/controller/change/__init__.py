"""The spine of every change: lock, lease, journal, manifest, and the verdict an error tells."""
