"""Pooling of results over seeds, and the checks of the claims."""
