"""Shapes as the steps take them (5.1, the data): read, cleaned, some of them mirrored.

Of several structures those of a subject are mirrored together, all of them by x and -x in the one
frame of its scan, so that how they lie to each other is mirrored with them and stays as it is.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.input.hands import AUTO, hands, of_other_hand, subjects_of_other_hand, to_reflect
from s4a.options import Options
from s4a.schema import dataset
from s4a.study.doubts import looks_of
from s4a.study.runner import Keys, Run, Task
from s4a.study.sources import Marked, Sources
from s4a.study.store import is_done, lock, read, task_key, write
from s4a.study.structures import Part
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
        return to_reflect(str(options.reflect), list(sources), subjects), []
    file = run.folder / CHOICE
    contents = [content for _, content in sources.values()]
    key = task_key(list(sources), contents, options.of("cleaning"), options.k, AUTO)
    if not is_done(file, key):
        looks = looks_as_given(run, sources, marked, options)
        reflected, told = of_other_hand(looks)
        handedness = hands(looks) if looks else np.zeros(0)
        write_choice(file, key, dict(zip(looks, handedness, strict=True)), reflected, told)
    reflected, told = read_choice(file)
    tell(told)
    return reflected, told


def choose_together(
    folder: Path, parts: Mapping[str, Part], options: Options, n_jobs: int | None
) -> dict[str, Part]:
    """Several structures, with the subjects of the rarer hand among those that are mirrored.

    Each structure is held against that of other subjects, and all of a subject say together of
    which hand it is; ``network/hands`` of each structure keeps the choice.
    """
    given = [
        [name, list(part.sources), [content for _, content in part.sources.values()]]
        for name, part in parts.items()
    ]
    cleaning = [part.options.of("cleaning") for part in parts.values()]
    key = task_key(given, cleaning, options.k, AUTO)
    files = {name: folder / name / CHOICE for name in parts}
    if not all(is_done(file, key) for file in files.values()):
        looks = {}
        for name, part in parts.items():
            log.info("structure %s, of which hand", name)
            with lock(folder / name) as claim:
                run = Run(claim, n_jobs)
                with run.unforeseen_told():
                    looks[name] = looks_as_given(run, part.sources, part.marked, part.options)
        hand, reflected, told = subjects_of_other_hand(looks)
        for name, file in files.items():
            write_choice(file, key, {one: hand[one] for one in looks[name]}, reflected, told)
    chosen = {name: read_choice(file) for name, file in files.items()}
    tell(next(iter(chosen.values()))[1])
    everyone = sorted({subject for reflected, _ in chosen.values() for subject in reflected})
    return {name: part._replace(chosen=(everyone, chosen[name][1])) for name, part in parts.items()}


def looks_as_given(
    run: Run, sources: Sources, marked: Marked, options: Options
) -> dict[str, xr.Dataset]:
    """What is seen in the shapes before any is mirrored; nothing of a single one."""
    original = read_and_clean(run, sources, marked, options, [])
    return looks_of(run, original, options) if len(original) > 1 else {}


def write_choice(
    file: Path, key: str, hand: Mapping[str, float], reflected: list[str], told: list[str]
) -> None:
    """Which shapes are mirrored, of which hand each is, and what is told of the choice."""
    choice = dataset(
        {"told": "\n".join(told)},
        handedness=np.array(list(hand.values()), float),
        reflected=np.array([name in reflected for name in hand], int),
    )
    write(choice.assign_coords(shape=list(hand)), file, key)


def read_choice(file: Path) -> tuple[list[str], list[str]]:
    """The shapes that are mirrored, and what is told of the choice."""
    choice = read(file)
    reflected = choice["shape"].values[choice["reflected"].values.astype(bool)].tolist()
    return reflected, choice.attrs["told"].splitlines()


def tell(lines: list[str]) -> None:
    """Each line as a warning of the log."""
    for line in lines:
        log.warning("%s", line)
