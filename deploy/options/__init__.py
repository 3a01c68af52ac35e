"""Command-line options, one dataclass per command."""
