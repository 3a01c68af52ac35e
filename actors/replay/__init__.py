"""Replay shards, with uniform or prioritised sampling."""
