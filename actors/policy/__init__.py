"""Action selection: the Q-network as a policy, and baselines that do not learn."""
