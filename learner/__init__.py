"""What runs once: update, pacing, checkpoints, tracking and the training loop."""
