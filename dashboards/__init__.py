"""What people look at: curves, strips, videos and the episode player, from results alone."""
