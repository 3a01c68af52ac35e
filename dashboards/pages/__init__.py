"""Web pages: the report, the episode player, and the local server."""
