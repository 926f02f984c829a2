"""One file per physical effect."""
