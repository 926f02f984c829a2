"""The card put together, and how it comes up."""
