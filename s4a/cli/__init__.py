"""The command line."""

from s4a.cli.flags import main, parser

__all__ = ["main", "parser"]
