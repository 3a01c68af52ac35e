"""A grid of trainings: `grid.py` makes its cells, `tune.py` schedules them, `cell.py` runs one and logs to MLflow."""
