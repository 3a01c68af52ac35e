"""Fault injection into a small training, and the invariants that must hold afterwards."""
