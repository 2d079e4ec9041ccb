"""Morphometrics on studies of S4A: an extension made of public names of ``s4a`` only.

=====================  =====================================================================
left and right         :func:`asymmetry`, :func:`asymmetry_modes`, :func:`symmetry`,
                       :func:`symmetric_template`
several visits         :func:`growth`
fields on the shapes   :func:`with_field`, :func:`write_field`, :func:`field_group_test`,
                       :func:`field_group_map`, :func:`field_regression`,
                       :func:`field_classify`, :func:`covariation`, :func:`covariation_modes`
regions, nuisances     :func:`within`, :func:`without`, :func:`with_size`, :class:`Region`
model measures         :func:`generalization`
parts of shapes        :func:`complete`, :func:`write_completed`
several structures     :func:`analyse_structures`, :func:`open_structures`,
                       :func:`insert_structures`, :func:`of_structure`, :func:`structures`,
                       :func:`structures_modes`, :func:`structures_of_new`
other programs         :func:`write_for`, :func:`write_label_volumes`, :func:`write_training_set`
=====================  =====================================================================

They are imported when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
