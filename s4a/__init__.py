"""S4A: scalable spectral statistical shape analysis of collections of high-resolution meshes.

The public names, by section of the paper:

========================  ====================================================================
reading and cleaning      :func:`read_shapes`, :func:`read_shape`, :func:`read_labels`,
                          :func:`clean`, :func:`with_landmarks`, :func:`with_features`,
                          :func:`read_mesh`, :func:`write_mesh`
4.1 low resolution        :func:`coarsen`
3.3 spectrum              :func:`spectrum`, :func:`reconstruct`
4.1 pairs                 :func:`match_pair`
5.1 metrics               :mod:`s4a.metrics`
5.2, 5.3 comparison       :mod:`s4a.compare`
4.1, 4.2 step by step     :func:`align_pair`, :func:`build_network`, :func:`refine_network`,
                          :func:`latent_match`, :func:`latent_map`, :func:`register_shape`
4.2, 6.1 collections      :func:`analyse`, :func:`open_study`, :func:`verify`, :func:`synthesize`
notebooks, pages          :func:`explore`, :func:`write_page`
pictures, films           :func:`write_picture`, :func:`write_film`
new shapes                :func:`insert`
6.1 statistics            :mod:`s4a.statistics`
6.2 transfer              :func:`transfer_labels`, :func:`transfer_landmarks`,
                          :func:`transfer_scalars`, :func:`register_pairs`, :func:`with_field`
for other programs        :func:`write_registered`, :func:`write_label_volumes`
the bundled collection    :mod:`s4a.synthetic`
========================  ====================================================================

They and the modules of the rooms (``s4a.method.fmap``) are imported when they are first used.
"""

from functools import partial
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from s4a._moved import install

if TYPE_CHECKING:
    from s4a import widgets as widgets
    from s4a.accessor import explore
    from s4a.analysis import statistics
    from s4a.analysis.export import write_registered
    from s4a.analysis.fields import with_field
    from s4a.analysis.transfer import (
        register_pairs,
        transfer_labels,
        transfer_landmarks,
        transfer_scalars,
    )
    from s4a.analysis.volumes import write_label_volumes
    from s4a.datasets import synthetic
    from s4a.evaluation import compare, metrics
    from s4a.input.clean import clean
    from s4a.input.collection import read_labels, read_shape, read_shapes
    from s4a.input.files import read_mesh, write_mesh
    from s4a.input.landmarks import with_landmarks
    from s4a.input.scalars import with_features
    from s4a.method.pca import synthesize
    from s4a.method.remesh import coarsen
    from s4a.method.spectral import reconstruct, spectrum
    from s4a.method.steps import (
        align_pair,
        build_network,
        latent_map,
        latent_match,
        refine_network,
        register_shape,
    )
    from s4a.show.page import write_page
    from s4a.show.pictures import write_film, write_picture
    from s4a.study.insert import insert
    from s4a.study.pair import match_pair
    from s4a.study.pipeline import analyse
    from s4a.study.tree import open_study
    from s4a.study.verify import verify

install()
__version__ = version("s4a")
__all__ = [
    "align_pair",
    "analyse",
    "build_network",
    "clean",
    "coarsen",
    "compare",
    "explore",
    "insert",
    "latent_map",
    "latent_match",
    "match_pair",
    "metrics",
    "open_study",
    "read_labels",
    "read_mesh",
    "read_shape",
    "read_shapes",
    "reconstruct",
    "refine_network",
    "register_pairs",
    "register_shape",
    "spectrum",
    "statistics",
    "synthesize",
    "synthetic",
    "transfer_labels",
    "transfer_landmarks",
    "transfer_scalars",
    "verify",
    "with_features",
    "with_field",
    "with_landmarks",
    "write_film",
    "write_label_volumes",
    "write_mesh",
    "write_page",
    "write_picture",
    "write_registered",
]
# module -> the public names that it holds
PLACES = {
    "accessor": "explore",
    "analysis": "statistics",
    "analysis.export": "write_registered",
    "analysis.fields": "with_field",
    "analysis.transfer": "register_pairs transfer_labels transfer_landmarks transfer_scalars",
    "analysis.volumes": "write_label_volumes",
    "datasets": "synthetic",
    "evaluation": "compare metrics",
    "input.clean": "clean",
    "input.collection": "read_labels read_shape read_shapes",
    "input.landmarks": "with_landmarks",
    "input.files": "read_mesh write_mesh",
    "input.scalars": "with_features",
    "method.pca": "synthesize",
    "method.remesh": "coarsen",
    "method.spectral": "reconstruct spectrum",
    "method.steps": "align_pair build_network latent_map latent_match refine_network "
    "register_shape",
    "show.page": "write_page",
    "show.pictures": "write_film write_picture",
    "study.insert": "insert",
    "study.pair": "match_pair",
    "study.pipeline": "analyse",
    "study.tree": "open_study",
    "study.verify": "verify",
}
MODULE_OF = {name: module for module, names in PLACES.items() for name in names.split()}


if not TYPE_CHECKING:  # or every misspelt name would pass as Any

    def __getattr__(name: str) -> Any:
        """A public name, imported now; ``study.s4a`` is there from the first one on."""
        if name == "widgets":  # a room that pip install "s4a[notebook]" brings
            return import_module("s4a.widgets")
        if name not in MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        import_module("s4a.accessor")
        globals()[name] = getattr(import_module(f"s4a.{MODULE_OF[name]}"), name)
        return globals()[name]


def __dir__() -> list[str]:
    """What completion offers."""
    return sorted({*globals(), *__all__, "widgets"})


def _module_of(room: str, name: str) -> ModuleType:
    """A module of a room, imported now."""
    if find_spec(f"s4a.{room}.{name}") is None:
        raise AttributeError(f"module 's4a.{room}' has no attribute {name!r}")
    return import_module(f"s4a.{room}.{name}")


for _room in ("analysis", "datasets", "evaluation", "geometry", "input", "method", "show", "study"):
    vars(import_module(f"s4a.{_room}"))["__getattr__"] = partial(_module_of, _room)
