"""The command line."""

from s4a.cli.flags import Command, add_options, main, number_or_name, parser, whole

__all__ = ["Command", "add_options", "main", "number_or_name", "parser", "whole"]
