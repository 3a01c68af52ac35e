"""Web pages: the report, the episode player, the local server."""
