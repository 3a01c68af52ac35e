"""The one place that knows Ray (sweeps use Ray Tune beside it)."""
