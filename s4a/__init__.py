"""S4A: scalable spectral statistical shape analysis of collections of high-resolution meshes.

The public names, by section of the paper:

========================  ====================================================================
reading and cleaning      :func:`read_shapes`, :func:`read_shape`, :func:`read_labels`,
                          :func:`clean`, :func:`with_landmarks`, :func:`with_features`,
                          :func:`read_mesh`, :func:`write_mesh`
4.1 low resolution        :func:`coarsen`, :func:`projection_operator`
3.3 spectrum              :func:`spectrum`, :func:`reconstruct`
4.1 pairs                 :func:`match_pair`
5.1 metrics               :mod:`s4a.metrics`
5.2, 5.3 comparison       :func:`compare`, :func:`compare_collection`
4.1, 4.2 step by step     :func:`align_pair`, :func:`build_network`, :func:`refine_network`,
                          :func:`latent_match`, :func:`latent_map`, :func:`register_shape`
4.2, 6.1 collections      :func:`analyse`, :class:`Options`, :func:`open_study`,
                          :func:`verify`, :func:`synthesize`
notebooks, pages          :func:`explore`, :func:`write_page`
pictures, films           :func:`write_picture`, :func:`write_film`
new shapes                :func:`insert`
6.1 statistics            :mod:`s4a.statistics`
6.2 transfer              :func:`transfer_labels`, :func:`transfer_landmarks`,
                          :func:`transfer_scalars`, :func:`register_pairs`,
                          :func:`correspondence`
for other programs        :func:`write_registered`
the bundled collection    :mod:`s4a.synthetic`
========================  ====================================================================

They and the modules of the subpackages (``s4a.method.fmap``) are imported when they are first used;
which they are says ``__init__.pyi``.
"""

from importlib import import_module
from importlib.metadata import version
from typing import Any

import lazy_loader

__version__ = version("s4a")
_first_use, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__.remove("widgets")  # needs pip install "s4a[notebook]", and `from s4a import *` does not


def __getattr__(name: str) -> Any:
    """Import a public name; from the first one on ``study.s4a`` is there."""
    found = _first_use(name)
    import_module("s4a.accessor")
    return found
