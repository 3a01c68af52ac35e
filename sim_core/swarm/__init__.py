"""The swarm: start positions, neighbour search, flocking, and the step of all worlds."""
