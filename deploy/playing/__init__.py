"""Who plays which episodes for `shoal evaluate` and `shoal stress`, and what was played."""
