"""The card behind sockets and terminals, as fast as wanted."""
