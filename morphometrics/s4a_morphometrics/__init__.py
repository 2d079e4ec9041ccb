"""Morphometrics on studies of S4A: an extension made of public names of ``s4a`` only."""

from s4a_morphometrics.poses import structures, structures_modes, structures_of_new
from s4a_morphometrics.several import (
    analyse_structures,
    insert_structures,
    of_structure,
    open_structures,
)

__all__ = [
    "analyse_structures",
    "insert_structures",
    "of_structure",
    "open_structures",
    "structures",
    "structures_modes",
    "structures_of_new",
]
