"""The sharded replay buffer."""
