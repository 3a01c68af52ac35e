"""Greedy episodes, their statistics, and how they are stored."""
