"""Calls between components, the messages they carry, and what is done when a call fails."""
