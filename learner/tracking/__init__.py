"""What is recorded of a run: the metrics journal, its delivery to MLflow, the log of faults, the names of metrics."""
