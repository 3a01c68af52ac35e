"""Rollout workers: vector environments, exploration, n-step transitions."""
