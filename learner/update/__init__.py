"""The Double DQN update."""
