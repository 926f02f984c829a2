"""Conversations with the card: lines, packets, dual-ported RAM; what is answered and refused."""
