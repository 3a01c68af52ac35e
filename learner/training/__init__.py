"""What the training loop is made of: counters, pacing, recovery, saving."""
