"""What is left of a run's components where the run does not begin."""

import pytest

from learner.engine import closed_on_error
from sim_core.checks import ConfigError


class Components:
    """Stands in for a Cluster."""

    closed = 0

    def close(self):
        self.closed += 1


@pytest.mark.parametrize("error", [ConfigError("refused"), OSError("full"), KeyboardInterrupt()])
def test_components_are_closed_whatever_keeps_the_run_from_beginning(error):
    cluster = Components()
    with pytest.raises(type(error)), closed_on_error(cluster):
        raise error
    assert cluster.closed == 1


def test_components_of_a_run_that_begins_stay():
    cluster = Components()
    with closed_on_error(cluster):
        pass
    assert cluster.closed == 0
