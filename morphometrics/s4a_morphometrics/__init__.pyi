from .bilateral import asymmetry, asymmetry_modes
from .bilateral_pairs import symmetric_template, symmetry
from .completion import complete, write_completed
from .field_tests import field_classify, field_group_map, field_group_test, field_regression
from .fields import with_field, write_field
from .leave_one_out import generalization
from .longitudinal import growth
from .poses import structures, structures_modes, structures_of_new
from .programs import write_for, write_training_set
from .region_panel import Region
from .restrict import with_size, within, without
from .several import analyse_structures, insert_structures, of_structure, open_structures
from .two_block import covariation, covariation_modes
from .volumes import write_label_volumes

__all__ = [
    "Region",
    "analyse_structures",
    "asymmetry",
    "asymmetry_modes",
    "complete",
    "covariation",
    "covariation_modes",
    "field_classify",
    "field_group_map",
    "field_group_test",
    "field_regression",
    "generalization",
    "growth",
    "insert_structures",
    "of_structure",
    "open_structures",
    "structures",
    "structures_modes",
    "structures_of_new",
    "symmetric_template",
    "symmetry",
    "with_field",
    "with_size",
    "within",
    "without",
    "write_completed",
    "write_field",
    "write_for",
    "write_label_volumes",
    "write_training_set",
]
