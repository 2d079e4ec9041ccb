"""The options of an analysis (4, 5.1): what each may be, what the preset sets.

Checked when they are made, before anything is read or computed.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from types import NoneType
from typing import Self, get_args

import numpy as np
import xarray as xr

from s4a.input.clean import check_components
from s4a.method.median import NORMS
from s4a.schema import check_switch, check_text

CHOICES = {
    "init": ("dense", "landmarks"),
    "refine": ("joint", "intrinsic"),
    "how": ("ours", "standard"),
    "norm": tuple(NORMS),
    "preset": (None, "paper"),
}
# what a preset sets; one of these options that is not given is None until then
DEFAULTS = {"init": "dense", "refine": "joint", "how": "ours"}
PRESETS = {None: DEFAULTS, "paper": {"init": "landmarks", "refine": "intrinsic", "how": "ours"}}
LOWEST = {"n_coarse": 100, "n_pairs": 1, "k_init": 4, "k": 4, "step": 1, "seed": 0, "n_latent": 2}


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of :func:`s4a.analyse`, which says what they are, with those of the preset.

    Raises
    ------
    ValueError
        When one is outside its range, or contradicts the preset; the range is named.

    Examples
    --------
    >>> from s4a.study.options import Options
    >>> options = Options(preset="paper", k=50)
    >>> options.refine, options.k, options.k_init
    ('intrinsic', 50, 20)
    >>> Options(preset="paper", refine="joint")
    Traceback (most recent call last):
    ValueError: preset 'paper' sets refine='intrinsic'; found refine='joint': leave out one of both
    """

    n_coarse: int = 6000
    n_pairs: int = 500
    k_init: int = 20
    k: int = 100
    n_latent: int | None = None
    step: int = 5
    # of these three the preset sets what is None
    init: str | None = None
    refine: str | None = None
    how: str | None = None
    norm: str = "h2"
    scale: bool = False
    components: str | int = "largest"
    strict: bool = False
    close_holes: bool = False
    wrap: bool = False
    intersections: bool = True
    pattern: str | None = None
    preset: str | None = None
    template: str | None = None
    table: Path | str | None = None
    seed: int = 0

    def __post_init__(self):
        self._check_choices()
        self._apply_preset()
        self._check_numbers()
        for field in fields(self):
            if field.type is bool:
                check_switch(field.name, getattr(self, field.name))
        check_components(self.components)
        check_text("pattern", self.pattern)
        check_text("template", self.template)

    def _check_choices(self):
        for name, legal in CHOICES.items():
            value = getattr(self, name)
            if value not in legal and not (value is None and name in DEFAULTS):
                choices = ", ".join(map(repr, legal))
                raise ValueError(f"{name} must be one of {choices}; found {value!r}")

    def _apply_preset(self):
        for name, value in PRESETS[self.preset].items():
            own = getattr(self, name)
            if self.preset and own not in (None, value):
                raise ValueError(
                    f"preset {self.preset!r} sets {name}={value!r}; found {name}={own!r}: "
                    "leave out one of both"
                )
            object.__setattr__(self, name, own or value)

    def _check_numbers(self):
        for name, least in LOWEST.items():
            value = getattr(self, name)
            if name == "n_latent" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name} must be an integer of at least {least}; found {value!r}")
        if self.k < self.k_init:
            raise ValueError(f"k must be at least k_init = {self.k_init}; found {self.k}")
        if self.n_latent is not None and self.n_latent > self.k:
            raise ValueError(f"n_latent must be at most k = {self.k}; found {self.n_latent}")

    def check_against(self, names: list[str]) -> None:
        """Raise ValueError where the options do not fit the shapes of these names.

        A template that is none of them, or too few pairs.
        """
        if self.template is not None and self.template not in names:
            raise ValueError(
                f"template {self.template!r} is none of the shapes: {', '.join(names)}"
            )
        n = len(names)
        if self.n_pairs < n - 1:
            raise ValueError(
                f"n_pairs = {self.n_pairs!r} cannot connect {n} shapes: give an integer from "
                f"{n - 1} (a tree) to {n * (n - 1) // 2} (all pairs)"
            )

    def to_report(self) -> dict[str, str]:
        """The options in words, as the attributes of ``/report``."""
        return {field.name: str(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_report(cls, study: xr.DataTree) -> Self:
        """The options of a study from its ``/report``; the default of one that it does not name.

        Examples
        --------
        >>> import xarray as xr
        >>> from s4a.study.options import Options
        >>> options = Options(k=50, components=2, scale=True)
        >>> report = xr.Dataset(attrs=options.to_report())
        >>> Options.from_report(xr.DataTree.from_dict({"report": report})) == options
        True
        """
        words = study["report"].attrs if "report" in study else {}
        return cls(
            **{
                field.name: _in_kind(words[field.name], get_args(field.type) or (field.type,))
                for field in fields(cls)
                if field.name in words
            }
        )


def _in_kind(word, kinds):
    """The value of an option that may be of these kinds, from its word in a report."""
    if word == "None" and NoneType in kinds:
        return None
    if bool in kinds:
        return word == "True"
    return int(word) if int in kinds and word.isdigit() else word


def takes_options(function: Callable) -> Callable:
    """Decorate a function of ``**options`` so that its signature shows those of :class:`Options`.

    Each option and its default stand in :class:`Options` alone.
    """
    signature = inspect.signature(function)
    own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = inspect.signature(Options).parameters.values()
    shown = signature.replace(parameters=[*own, *options])
    function.__signature__ = shown  # type: ignore[attr-defined]
    return function
