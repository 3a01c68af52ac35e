"""The swarm: start positions, neighbour search, flocking, one step of every world."""
