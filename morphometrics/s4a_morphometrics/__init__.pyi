from .bilateral import asymmetry, asymmetry_modes
from .completion import complete, write_completed
from .halves import symmetric_template, symmetry
from .longitudinal import growth
from .programs import write_for, write_training_set
from .two_block import covariation, covariation_modes

__all__ = [
    "asymmetry",
    "asymmetry_modes",
    "complete",
    "covariation",
    "covariation_modes",
    "growth",
    "symmetric_template",
    "symmetry",
    "write_completed",
    "write_for",
    "write_training_set",
]
