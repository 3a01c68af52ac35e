"""A grid of trainings: its cells, and running them on Ray Tune."""
