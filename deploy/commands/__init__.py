"""One module per command of `shoal`, each with `run(options) -> exit code`."""
