"""What chooses actions: the Q-network as a policy, and rules that learn nothing."""
