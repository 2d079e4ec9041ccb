"""The options of an analysis (4, 5.1): what each may be, what the preset sets.

Checked when they are made, before anything is read or computed.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import NoneType
from typing import Any, Self, TypeVar, get_args

import xarray as xr

from s4a.input.clean import check_components
from s4a.input.files import slug
from s4a.input.labels import check_label
from s4a.method.first_map import INITS
from s4a.method.latent import PER_FUNCTION, WEIGHTS
from s4a.method.median import NORMS
from s4a.method.register import WORDS
from s4a.method.shape import N_CENTRAL, N_SPREAD, Shape
from s4a.schema import check_choice, check_count, check_switch, check_text
from s4a.seeds import RNG, seeded

CHOICES = {
    "method": ("rematch", "scalable"),
    "init": INITS,
    "ahead": ("always", "network", "never"),
    "weights": WEIGHTS,
    **WORDS,
    "norm": tuple(NORMS),
    "preset": (None, "paper", "fast"),
    "doubtful": ("apart", "stop"),
}
# what is added to the paper, each with its switch; in PAPER none of it.  These are the options that
# a preset sets: one that is not given is None until then
DEFAULTS = {
    "lift": False,
    "init": "dense",
    "ahead": "always",
    "n_spread": N_SPREAD,
    "wide": 4,
    "sharpen": 1,
    "refine": "elastic",
    "parts": True,
    "alignment": "fitted",
    "area_weighted": True,
    "n_projected": N_CENTRAL,
    "both": True,
}
PAPER = {
    "lift": False,
    "init": "landmarks",
    "ahead": "network",
    "n_spread": 0,
    "wide": 0,
    "sharpen": 0,
    "refine": "intrinsic",
    "parts": False,
    "alignment": "icp",
    "area_weighted": False,
    "n_projected": 0,
    "both": False,
}
# about half the time, and what that costs: docs/clusters.md
FAST = {"n_coarse": 3000, "n_spread": 500, "wide": 0}
N_COARSE = 6000  # vertices of a low-resolution mesh, where no preset says another number
PRESETS: dict[str | None, dict[str, Any]] = {
    None: DEFAULTS | {"n_coarse": N_COARSE},
    "paper": PAPER,
    "fast": FAST,
}
Function = TypeVar("Function", bound=Callable[..., Any])
BY_PRESET: Any = None  # an option that is not given, until the preset has set it
# switches that method="scalable" does not have, and what each would need
WITHOUT_MESH = {
    "lift": "lifts the eigenfunctions of one",
    "wrap": "makes one of a wrapped surface, on which its functions do not live",
}
LOWEST = {
    "n_coarse": 100,
    "n_pairs": 1,
    "k_init": 4,
    "k": 4,
    "n_latent": 2,
    "step": 1,
    "n_spread": 0,
    "wide": 0,
    "sharpen": 0,
    "n_projected": 0,
    "seed": 0,
}
# of a pair that is matched on its own
PAIR = (
    "k_init",
    "k",
    "step",
    "lift",
    "init",
    "ahead",
    "sharpen",
    "refine",
    "parts",
    "alignment",
    "area_weighted",
    "n_projected",
    "n_coarse",
    "method",
    "preset",
    "seed",
)


def apply_preset(
    preset: str | None, given: dict[str, Any], presets: dict[str | None, dict[str, Any]]
) -> dict[str, Any]:
    """The options that presets set: that of None those that the chosen one does not.

    An option that is `given`, and not as None, stays as it is.

    Raises
    ------
    ValueError
        When the chosen preset sets an option that is given otherwise, or is none.

    Examples
    --------
    >>> from s4a.study.options import PRESETS, apply_preset
    >>> apply_preset("paper", {"sharpen": None}, PRESETS)["sharpen"]
    0
    """
    if preset not in presets:
        choices = ", ".join(map(repr, presets))
        raise ValueError(f"preset must be one of {choices}; found {preset!r}")
    settings = {}
    for name, value in (presets[None] | presets[preset]).items():
        own = given.get(name)
        if preset and name in presets[preset] and own is not None and own != value:
            raise ValueError(
                f"preset {preset!r} sets {name}={value!r}; found {name}={own!r}: "
                "leave out one of both"
            )
        settings[name] = value if own is None else own
    return settings


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

    method: str = "rematch"
    n_pairs: int = 500
    k_init: int = 20
    k: int = 100
    n_latent: int | None = None
    step: int = 5
    weights: str = "cycles"
    n_coarse: int = BY_PRESET
    lift: bool = BY_PRESET
    init: str = BY_PRESET
    ahead: str = BY_PRESET
    n_spread: int = BY_PRESET
    wide: int = BY_PRESET
    sharpen: int = BY_PRESET
    refine: str = BY_PRESET
    parts: bool = BY_PRESET
    alignment: str = BY_PRESET
    area_weighted: bool = BY_PRESET
    n_projected: int = BY_PRESET
    both: bool = BY_PRESET
    how: str = "ours"
    norm: str = "h2"
    keep_rounds: bool = False
    scale: bool = False
    components: str | int = "largest"
    strict: bool = False
    close_holes: bool = False
    wrap: bool = False
    intersections: bool = True
    pattern: str | None = None
    label: int | str | None = None
    preset: str | None = None
    template: str | None = None
    reflect: str | list[str] | None = None
    table: Path | str | None = None
    landmarks: Path | str | None = None
    features: str | list[str] | None = None
    doubtful: str = "apart"
    keep_doubtful: bool = False
    seed: int = 0

    def __post_init__(self):
        self._check_choices()
        for name, value in apply_preset(self.preset, vars(self), PRESETS).items():
            object.__setattr__(self, name, value)
        self._check_numbers()
        for field in fields(self):
            if bool in (field.type, *get_args(field.type)):
                check_switch(field.name, getattr(self, field.name))
        check_components(self.components)
        object.__setattr__(self, "label", check_label(self.label))
        check_text("pattern", self.pattern)
        check_text("template", self.template)
        if isinstance(self.reflect, list):
            object.__setattr__(self, "reflect", ",".join(map(str, self.reflect)))
        check_text("reflect", self.reflect)
        self._check_features()
        if self.landmarks is not None and self.refine != "elastic":
            raise ValueError(
                f"landmarks pull elastic rounds, and refine={self.refine!r} makes none: "
                "leave out one of both"
            )
        if self.method == "scalable":
            for name, why in WITHOUT_MESH.items():
                if getattr(self, name):
                    raise ValueError(
                        f"method='scalable' has no coarse mesh, and {name}=True {why}: "
                        "leave out one of both"
                    )
        if self.keep_doubtful and self.doubtful == "stop":
            raise ValueError(
                "keep_doubtful=True takes doubtful shapes in and doubtful='stop' ends the run "
                "where there are any: leave out one of both"
            )

    def _check_features(self):
        if isinstance(self.features, list | tuple):
            object.__setattr__(self, "features", ",".join(map(str, self.features)))
        check_text("features", self.features)
        wrong = [name for name in self.feature_names if slug(name) != name]
        if wrong:
            raise ValueError(f"features need names of letters, digits, _ and -, found {wrong[0]!r}")
        if self.features is not None and self.label is not None:
            raise ValueError(
                "features= are fields of the vertices of meshes, and label= makes meshes of "
                "volumes, whose vertices nobody knows before: leave out one of both"
            )

    def _check_choices(self):
        for name, legal in CHOICES.items():
            value = getattr(self, name)
            if value is not None or name not in PRESETS[None]:
                check_choice(name, value, legal)

    def _check_numbers(self):
        for name, least in LOWEST.items():
            value = getattr(self, name)
            if name == "n_latent" and value is None:
                continue
            check_count(name, value, least)
        if self.k < self.k_init:
            raise ValueError(f"k must be at least k_init = {self.k_init}; found {self.k}")
        if self.n_latent is not None and self.n_latent > self.k:
            raise ValueError(f"n_latent must be at most k = {self.k}; found {self.n_latent}")
        own = (PRESETS[None] | PRESETS[self.preset])["n_spread"]
        if self.n_spread != own:  # pairs, of any k, take no notice of a default
            self.check_spread()

    def check_spread(self) -> None:
        """ValueError where Consistent ZoomOut would have too few spread vertices for k."""
        least = min(PER_FUNCTION * self.k, self.n_coarse)
        if 0 < self.n_spread < least:
            raise ValueError(
                f"n_spread must be 0, for all vertices, or at least {least}, for k = {self.k}; "
                f"found {self.n_spread}"
            )

    @property
    def of_cleaning(self) -> dict[str, Any]:
        """The options of :func:`s4a.input.collection.read_shape`."""
        names = ["components", "strict", "close_holes", *["label"] * (self.label is not None)]
        return {name: getattr(self, name) for name in names}

    @property
    def of_low_resolution(self) -> dict[str, Any]:
        """The options of :func:`s4a.method.lift.low_resolution`."""
        names = ("method", "n_coarse", "k", "lift", "wrap", "seed")
        return {name: getattr(self, name) for name in names}

    @property
    def of_first_maps(self) -> dict[str, Any]:
        """The options of :func:`s4a.method.first_map.first_map` in a network, but its size."""
        return {"init": self.init, "ahead": self.ahead != "never", "n_spread": self.n_spread}

    @property
    def of_registration(self) -> dict[str, Any]:
        """The options of :func:`s4a.method.register.register`."""
        names = ("refine", "scale", "parts", "alignment")
        return {name: getattr(self, name) for name in names}

    def shape(self, original: xr.Dataset, coarse: xr.Dataset) -> Shape:
        """A shape whose fields are projected as these options say."""
        projection = {name: getattr(self, name) for name in ("n_projected", "area_weighted")}
        return Shape(original, coarse, **projection)

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

    def changed(self, given: dict[str, Any]) -> Self:
        """These options with some given otherwise; a `preset` that is given sets its own anew.

        What the preset before it set stands as the default again.

        Raises
        ------
        ValueError
            When one is outside its range, or contradicts the preset, the given or the own.

        Examples
        --------
        >>> from s4a.study.options import Options
        >>> options = Options(k=50).changed({"preset": "paper"})
        >>> options.k, options.refine
        (50, 'intrinsic')
        >>> options.changed({"refine": "joint"})
        Traceback (most recent call last):
        ValueError: preset 'paper' sets refine='intrinsic'; found refine='joint': leave out one of \
both
        """
        unset: dict[str, None] = {}
        if "preset" in given:
            new, own = given["preset"] or "paper", self.preset or "paper"
            unset = dict.fromkeys([*PAPER, *PRESETS[own], *PRESETS.get(new, ())])
        return replace(self, **unset | given)

    def to_report(self) -> dict[str, str]:
        """The options in words, as the attributes of ``/report``."""
        return {field.name: str(getattr(self, field.name)) for field in fields(self)}

    @property
    def feature_names(self) -> list[str]:
        """Names of the fields that guide registration."""
        return self.features.split(",") if isinstance(self.features, str) else []

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
    return int(word) if int in kinds and word.isdecimal() else word


def takes_options(*names: str) -> Callable[[Function], Function]:
    """Decorate a function of ``**options`` so that its signature shows those of :class:`Options`.

    Those of these names, all by default, and ``rng`` beside ``seed``.  Each option and its default
    stand in :class:`Options` alone.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        options = inspect.signature(Options).parameters
        chosen = [options[name] for name in names or options]
        # what a preset sets may also be given as None
        chosen = [
            one.replace(annotation=one.annotation | None) if one.default is None else one
            for one in chosen
        ]
        if "seed" in (names or options):
            chosen.append(options["seed"].replace(name="rng", default=None, annotation=RNG | None))
        vars(function)["__signature__"] = signature.replace(parameters=[*own, *chosen])
        return function

    return decorate


def pair_options(given: dict[str, Any], of_study: Options | None = None) -> Options:
    """The :class:`Options` of a pair, beside those of a study where there is one.

    Raises
    ------
    TypeError
        When one is given that is none of a pair's.
    ValueError
        When one is outside its range, or contradicts the preset.
    """
    given = seeded(given)
    wrong = [name for name in given if name not in (*PAIR, "both")]
    if wrong:
        raise TypeError(
            f"unexpected options {', '.join(wrong)}; those of a pair are {', '.join(PAIR)}"
        )
    return Options(**given) if of_study is None else of_study.changed(given)
