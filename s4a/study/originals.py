"""Shapes as the steps take them (5.1, the data): read, cleaned, some of them mirrored."""

import logging
from typing import Any

import numpy as np

from s4a.input.hands import AUTO, hands, of_other_hand, to_reflect
from s4a.options import Options
from s4a.schema import dataset
from s4a.study.doubts import looks_of
from s4a.study.netcdf import is_done, read
from s4a.study.runner import Keys, Run, Task
from s4a.study.sources import Marked, Sources
from s4a.study.store import task_key, write
from s4a.study.tasks import clean_shape

log = logging.getLogger(__name__)

CHOICE = "network/hands.nc"


def read_and_clean(
    run: Run, sources: Sources, marked: Marked, options: Options, reflected: list[str]
) -> Keys:
    """The shapes, cleaned, with landmarks, some of them mirrored (5.1): ``/original``."""
    cleaning = options.of("cleaning")
    todo = []
    for n, (source, content) in sources.items():
        also: dict[str, Any] = {"reflected": True} if n in reflected else {}
        key = (content, cleaning, *also.values())
        if n in marked:
            also["guides"] = landmarks, features = marked[n]
            # wherever the files lie
            key = (*key, *([landmarks[1]] if landmarks else []))
            key = (*key, *((name, content) for name, (_, content) in features.items()))
        given = (source, content, cleaning, also)
        todo.append(Task(n, f"original/{n}.nc", clean_shape, given, key))
    return run.do("read and clean", todo)


def choose_reflected(
    run: Run, sources: Sources, marked: Marked, options: Options
) -> tuple[list[str], list[str]]:
    """The shapes whose mirror images are taken, and what is told of the choice.

    Where the shapes themselves shall say (``reflect="auto"``), they are looked at as they are
    first; ``network/hands`` keeps the choice.
    """
    if options.reflect is None:
        return [], []
    if options.reflect != AUTO:
        table = run.folder / "subjects.nc"
        subjects = read(table) if table.is_file() else None
        reflected = to_reflect(str(options.reflect), list(sources), subjects)
        is_all = len(reflected) == len(sources)
        return reflected, ["reflect= mirrors all: nothing changes among them"] if is_all else []
    file = run.folder / CHOICE
    contents = [content for _, content in sources.values()]
    key = task_key(list(sources), contents, options.of("cleaning"), options.k, AUTO)
    if not is_done(file, key):
        original = read_and_clean(run, sources, marked, options, [])
        looks = looks_of(run, original, options) if len(original) > 1 else {}
        reflected, told = of_other_hand(looks)
        choice = dataset(
            {"told": "\n".join(told)},
            handedness=hands(looks) if looks else np.zeros(0),
            reflected=np.array([name in reflected for name in looks], int),
        )
        write(choice.assign_coords(shape=list(looks)), file, key)
    choice = read(file)
    told = choice.attrs["told"].splitlines()
    for line in told:
        log.warning("%s", line)
    return choice["shape"].values[choice["reflected"].values.astype(bool)].tolist(), told
