"""Variables, definitions and programs on the card: changed, kept, put there for a while."""
