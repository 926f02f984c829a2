"""The card's languages: scanner, expressions, program statements, program buffers."""
