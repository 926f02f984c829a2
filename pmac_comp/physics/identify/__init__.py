"""Linear start, output-error refinement, uncertainty, identifiability, next experiment."""
