"""Calls between components, the messages that they carry, and the reactions to failed calls."""
