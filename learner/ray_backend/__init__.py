"""The package that knows Ray; besides it, sweeps use Ray Tune, and `deploy` submits Ray jobs."""
