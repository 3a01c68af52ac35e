"""The start of the command `shoal`, which `python -m deploy` runs, too."""

import sys

from learner.own_processes import collect_rarely


def main() -> int:
    """Runs shoal in a process of its own, whose imports are large; returns the exit code."""
    collect_rarely()
    from deploy.cli import main as run  # after that

    return run()


if __name__ == "__main__":
    sys.exit(main())
