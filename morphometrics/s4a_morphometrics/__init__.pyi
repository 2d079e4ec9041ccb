from .bilateral import asymmetry, asymmetry_modes
from .bilateral_pairs import symmetric_template, symmetry
from .completion import complete, write_completed
from .longitudinal import growth
from .poses import structures, structures_modes, structures_of_new
from .programs import write_for, write_training_set
from .several import analyse_structures, insert_structures, of_structure, open_structures
from .two_block import covariation, covariation_modes

__all__ = [
    "analyse_structures",
    "asymmetry",
    "asymmetry_modes",
    "complete",
    "covariation",
    "covariation_modes",
    "growth",
    "insert_structures",
    "of_structure",
    "open_structures",
    "structures",
    "structures_modes",
    "structures_of_new",
    "symmetric_template",
    "symmetry",
    "write_completed",
    "write_for",
    "write_training_set",
]
