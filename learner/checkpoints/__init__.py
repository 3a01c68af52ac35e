"""Checkpoints: atomic writing, checksums, retention. `checkpoint.py` states the protocol."""
