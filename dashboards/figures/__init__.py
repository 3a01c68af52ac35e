"""Figures drawn by matplotlib, as PNG, and videos of episodes."""
