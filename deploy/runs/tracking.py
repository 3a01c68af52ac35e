"""Opens the MLflow store of a run that exists already."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from learner.run_folder import RunFolder
from learner.tracking.begin_tracking import TrackingStart
from learner.tracking.local_store import find_store
from learner.tracking.redaction import full_uri
from learner.tracking.tracked_run import TrackedRun


@contextmanager
def opened_tracker(folder: RunFolder) -> Iterator[TrackedRun]:
    """Within the `with` block, the run in its store, not resumed yet.

    Raises:
      ConfigError: its store cannot be opened, or has gone.
    """
    identity = folder.identity()
    uri = full_uri(find_store(identity.tracking_uri, identity.mlflow_run_id, folder.path))
    with TrackingStart() as start:
        start.open(uri, None, None)
        yield start.run()
