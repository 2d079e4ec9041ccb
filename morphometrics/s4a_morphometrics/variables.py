"""The variables that this extension adds to the table of :mod:`s4a.schema`."""

ROWS: dict[str, tuple[str, str, str]] = {}
