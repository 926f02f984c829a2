"""The conversation with a card, its registers and variables, and who it says it is."""
