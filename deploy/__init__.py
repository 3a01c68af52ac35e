"""The command line: options, commands, and what they write and show."""
