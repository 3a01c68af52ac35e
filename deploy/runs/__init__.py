"""Finding runs and policies, and the files they leave."""
