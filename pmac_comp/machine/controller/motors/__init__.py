"""Motors: where they are, how they move, and what is watched and switched beside them."""
