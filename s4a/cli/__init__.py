"""The command line."""

from s4a.cli.flags import HELP, Command, add_options, main, number_or_name, parser, whole

__all__ = ["HELP", "Command", "add_options", "main", "number_or_name", "parser", "whole"]
