"""The feed-forward law on the card: installed, loaded, armed, and what one pass of it costs."""
