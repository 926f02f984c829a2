"""The data spaces of the card and the variables laid over them, bytecode, buffers, flash."""
