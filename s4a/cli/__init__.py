"""The command line."""

from s4a.cli.flags import HELP, main, parser

__all__ = ["HELP", "main", "parser"]
