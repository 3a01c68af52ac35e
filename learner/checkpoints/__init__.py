"""Checkpoints: atomic writing, checksums, retention."""
