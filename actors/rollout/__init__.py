"""Stepping environments, exploring, and building n-step transitions."""
