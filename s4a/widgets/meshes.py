"""The surfaces of a study as a panel shows them.

Every shape moved onto the template, at low or full resolution.
"""

from uuid import uuid4

import numpy as np

from s4a.show.pictures import aligned, mesh_of

RESOLUTIONS = [("low resolution", "coarse"), ("full resolution", "original")]


def surface(study, name, stage="coarse"):
    """Aligned positions and triangles of a shape at the stage ``coarse`` or ``original``."""
    X, T = mesh_of(study[stage][name])
    return aligned(study, name, X), T


def camera_group():
    """A name that no other panel has.

    The views of one panel turn together, those of two panels do not.
    """
    return uuid4().hex


def available(study):
    """The resolutions that the study holds, as the options of a switch."""
    return [
        (text, stage)
        for text, stage in RESOLUTIONS
        if stage in study.children and study[stage].children
    ]


def unit_of(study, name):
    """The unit of a shape's positions where its file says it, or that it is the input's."""
    node = study["original"].children.get(name) if "original" in study.children else None
    return str((node.attrs.get("unit") if node is not None else "") or "unit of the input")


def nice(x):
    """The next number below that is 1, 2 or 5 times a power of ten.

    Examples
    --------
    >>> from s4a.widgets.meshes import nice
    >>> nice(17.3), nice(0.6)
    (10.0, 0.5)
    """
    power = 10.0 ** np.floor(np.log10(x))
    return float(power * max(m for m in (1, 2, 5) if m * power <= x * (1 + 1e-9)))
