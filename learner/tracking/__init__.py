"""The metrics journal and its delivery to MLflow."""
