"""Errors in the terms of README, Words: dynamic and total, ISO 230-2, ringing; captures alone."""
