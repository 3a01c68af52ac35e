"""Evaluation: greedy episodes on fixed seeds, their statistics, and their storage."""
