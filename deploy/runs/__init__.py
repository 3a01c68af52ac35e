"""Folders of runs and sweeps: names, artifacts, policies, results and their provenance."""
