"""Figures of the examples in docstrings."""

import doctest
import re

from matplotlib.figure import Figure

from s4a.show import charts


def figure_of(name, text):
    """Return the figure of the last example of a docstring, or None.

    All examples are run in their order; what they print is checked where they are tests.
    """
    examples = doctest.DocTestParser().get_examples(text, name)
    if not examples or not examples[-1].want.startswith(("<Figure ", "<TiledFigure ")):
        return None
    names = {}
    for example in examples[:-1]:
        exec(compile(example.source, name, "exec"), names)  # one statement, as doctest runs it
    figure = eval(compile(examples[-1].source.strip(), name, "eval"), names)
    if not isinstance(figure, Figure):
        raise TypeError(f"the last example of {name} needs a figure, found {type(figure)}")
    return figure


def draw(name, text, folder):
    """Write the figure of a docstring into a folder; return its path, or None."""
    figure = figure_of(name, text)
    if figure is None:
        return None
    folder.mkdir(exist_ok=True)
    path = folder / f"{re.sub(r'[^a-z0-9_]+', '-', name.lower())}.svg"
    path.write_bytes(charts.svg(figure))
    return path
