"""The bench file for people, its scales, and whether captures and models belong to it."""
