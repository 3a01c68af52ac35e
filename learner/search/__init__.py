"""A search over settings: `space.py` reads ranges, `config.py` makes trials, `study.py` is Optuna, `trial.py` runs one.

Ray Tune schedules the trials (`learner.sweep.tune`), and each trains cells of a sweep (`learner.sweep.cell`).
"""
