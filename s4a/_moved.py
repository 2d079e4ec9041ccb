"""Modules that lay beside each other before they were put into rooms: their old names still import.

``s4a.metrics`` and the other three public modules keep their short names; every other old name
warns and says the new one.  ``s4a.clean`` and ``s4a.insert`` are functions, as before.
"""

import sys
import warnings
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec

PUBLIC = {
    "compare": "evaluation.compare",
    "metrics": "evaluation.metrics",
    "statistics": "analysis.statistics",
    "synthetic": "datasets.synthetic",
}
ROOMS = {
    "geometry": "align mesh voronoi",
    "input": "annotations bounded formats landmarks manifold subjects",
    "method": "deform descriptors fmap joint latent lift median nearest network pca register "
    "remesh scalable spectral",
    "study": "pipeline",
    "analysis": "export link model permutation transfer",
    "evaluation": "accuracy",
    "show": "charts draw",
    "cli": "commands tables",
}
RENAMED = {
    "artefacts": "datasets.artifacts",
    "findings": "study.report",
    "generalize": "analysis.generalization",
    "io": "input.files",
    "picture": "show.pictures",
    "poses": "method.first_map",
    "shapes": "input.collection",
    "suspects": "input.plausibility",
    "tasks": "study.runner",
    "view": "show.page",
}
MOVED = {name: f"{room}.{name}" for room, names in ROOMS.items() for name in names.split()}
MOVED |= RENAMED | PUBLIC


class OldNames(MetaPathFinder, Loader):
    """Finds a module under its old name and gives the one of the new name, the same object."""

    def find_spec(self, fullname, path=None, target=None):
        package, _, name = fullname.partition(".")
        if package != __package__ or name not in MOVED:
            return None
        if name not in PUBLIC:
            new = f"{package}.{MOVED[name]}"
            warnings.warn(f"{fullname} is now {new}", DeprecationWarning, stacklevel=2)
        return ModuleSpec(fullname, self)

    def create_module(self, spec):
        module = import_module(f"{__package__}.{MOVED[spec.name.partition('.')[2]]}")
        self.own_spec = module.__spec__
        return module

    def exec_module(self, module):
        module.__spec__ = self.own_spec  # the import system has put that of the old name here


def install() -> None:
    """Let the old names be found, after all that really are modules."""
    if not any(isinstance(finder, OldNames) for finder in sys.meta_path):
        sys.meta_path.append(OldNames())
