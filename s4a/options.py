"""The options of an analysis (4, 5.1), each declared once, and all that follows from that.

A field of :class:`Options` says what an option may be, what the presets set, and what it does.  The
checks, the presets, the flags of the command line, what ``/report`` keeps, the docstring and the
table of the page on differences are made from it.  To add an option, add a field.
"""

import difflib
import json
import re
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import partial
from importlib.util import find_spec
from numbers import Integral
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Self, get_args

if TYPE_CHECKING:  # imported when they are first needed, so that a command starts at once
    import xarray as xr

N_COARSE = 6000  # vertices of a low-resolution mesh, where no preset says another number
N_SAMPLES = 1000  # spread vertices of a shape on which Consistent ZoomOut looks for matches
N_CENTRAL = 25_000  # vertices by which a field on a shape is projected
PER_FUNCTION = 2  # samples, at least: the least squares of fewer are poor, or have no one solution
FEATURE = re.compile(r"[A-Za-z0-9_-]{1,100}")  # as a file can be named
# switches that method="scalable" does not have, and what each would need
WITHOUT_MESH = {
    "lift": "lifts the eigenfunctions of one",
    "wrap": "makes one of a wrapped surface, on which its functions do not live",
}


def option(
    default: Any,
    help: str,
    *,
    group: str,
    more: str = "",
    choices: tuple[str, ...] = (),
    least: int = 0,
    check: Callable[[Any], Any] | None = None,
    paper: Any = MISSING,
    fast: Any = MISSING,
    section: str = "",
    instead: str = "",
    see: str = "",
    of: str = "",
    given_as: Callable[[Any], Any] | None = None,
    pair: bool = False,
) -> Any:
    """An option: a field whose metadata are all that is known of it.

    Parameters
    ----------
    default : object
        What it is where neither the caller nor the preset says.
    help : str
        What it does, in a few words: of the flag, and the first of the docstring.
    group : str
        Of options, among which the command line shows it.
    more : str
        What else is to be known: of the docstring, and of the page on differences.
    choices : tuple of str
        What a text may be.
    least : int
        The smallest that a number may be.
    check : callable, optional
        In place of what type, `choices` and `least` say: gives the value as it is kept.
    paper, fast : object, optional
        What these presets set.
    section, instead, see : str
        Where the paper has it, what stands there, and the module that has it here.
    of : str
        The step whose functions take it as a keyword, see :meth:`Options.of`.
    given_as : callable, optional
        From its value to that of the keyword, where they differ.
    pair : bool
        Whether pairs that are matched on their own have it.
    """
    told = {name: value for name, value in locals().items() if name not in ("paper", "fast")}
    told["presets"] = {
        name: value for name, value in (("paper", paper), ("fast", fast)) if value is not MISSING
    }
    return field(default=None if told["presets"] else default, metadata=told)


# of each group
reading = partial(option, group="input")
network = partial(option, group="low resolution and network")
registration = partial(option, group="registration")
quality = partial(option, group="quality control")
computing = partial(option, group="computing")


def check_components(components: Any) -> str | int:
    """`components`; ValueError unless it is "largest", "all" or a number from 1."""
    if (
        not isinstance(components, bool)
        and isinstance(components, Integral)
        and int(components) >= 1
    ):
        return int(components)
    if isinstance(components, str) and components in ("largest", "all"):
        return components
    raise ValueError(
        f'components needs to be "largest", "all" or a number from 1; found {components!r}'
    )


def check_label(label: Any) -> int | str | None:
    """A label as options keep it: a number, several as ``"1,2"``, ``"all"``, or None.

    Raises
    ------
    ValueError
        When it is none of these, or scikit-image is not installed.

    Examples
    --------
    >>> from s4a.options import check_label
    >>> check_label(17), check_label([2, 1]), check_label("1,2"), check_label("all")
    (17, '1,2', '1,2', 'all')
    """
    if label is None:
        return None
    known: int | str = "all"
    if label != "all":
        try:
            given: Any = label.split(",") if isinstance(label, str) else label
            numbers = [given] if isinstance(given, Integral) else list(given)
            if any(isinstance(one, bool | float) for one in numbers):
                raise ValueError
            wanted = sorted({int(one) for one in numbers})
        except (TypeError, ValueError):
            wanted = []
        if not wanted or 0 in wanted:
            raise ValueError(
                f"label needs a number other than 0, several (1,2) or 'all'; found {label!r}"
            )
        known = wanted[0] if len(wanted) == 1 else ",".join(map(str, wanted))
    if find_spec("skimage") is None:
        raise ValueError(
            "surfaces from label volumes need scikit-image, which is not installed; "
            "run: pip install 's4a[labels]'"
        )
    return known


def check(name: str, value: Any) -> Any:
    """The value of an option as it is kept.

    Raises
    ------
    ValueError
        When the option cannot be that; what it can be is named.

    Examples
    --------
    >>> from s4a.options import check
    >>> check("init", "landmark")
    Traceback (most recent call last):
    ValueError: init must be one of 'dense', 'landmarks'; found 'landmark'
    """
    from s4a.schema import check_choice, check_count, check_switch, check_text

    one = DECLARED[name]
    kinds = get_args(one.type) or (one.type,)
    if value is None and NoneType in kinds:
        return None
    if one.metadata["check"]:
        return one.metadata["check"](value)
    if one.metadata["choices"]:
        check_choice(name, value, one.metadata["choices"])
    elif bool in kinds:
        check_switch(name, value)
        return bool(value)
    elif int in kinds:
        check_count(name, value, one.metadata["least"])
        return int(value)
    elif list[str] in kinds and isinstance(value, list | tuple):
        return ",".join(map(str, value))
    elif Path in kinds and isinstance(value, Path):
        return str(value)
    else:
        check_text(name, value)
    return value


def apply_preset(
    preset: str | None, given: Mapping[str, Any], presets: Mapping[str | None, dict[str, Any]]
) -> dict[str, Any]:
    """The options that presets set: that of None those that the chosen one does not.

    An option that is `given`, and not as None, stays as it is.

    Raises
    ------
    ValueError
        When the chosen preset sets an option that is given otherwise, or is none.

    Examples
    --------
    >>> from s4a.options import PRESETS, apply_preset
    >>> apply_preset("paper", {"full_resolution_iterations": None}, PRESETS)["full_resolution_iterations"]
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
    """The options of :func:`s4a.analyse`, with those that the preset sets.

    Parameters
    ----------
    {options}

    Raises
    ------
    ValueError
        When one is outside its range, or contradicts the preset; the range is named.

    Examples
    --------
    >>> import s4a
    >>> options = s4a.Options(preset="paper", k=50)
    >>> options.refine, options.k, options.k_init
    ('intrinsic', 50, 20)
    >>> s4a.Options(preset="paper", refine="joint")
    Traceback (most recent call last):
    ValueError: preset 'paper' sets refine='intrinsic'; found refine='joint': leave out one of both
    """

    # fmt: off
    preset: str | None = computing(None,
        "'paper' leaves out all that is added to the paper; 'fast' halves the time",
        choices=("paper", "fast"), pair=True,
        more="The errors of 'fast' are a tenth larger (``benchmarks/cheaper.py``).  Another "
        "value of what a preset sets is refused; to add one thing to the paper, give "
        '``s4a.options.PRESETS["paper"]`` with that changed')
    seed: int = computing(0, "seed of all randomness", of="low resolution", pair=True,
        more="Or ``rng``, see :mod:`s4a.seeds`")
    pattern: str | None = reading(None, "only files whose name fits, for example '*brain*'")
    components: str | int = reading("largest",
        "'largest', 'all' or how many pieces of each mesh to keep", check=check_components,
        of="cleaning")
    strict: bool = reading(False,
        "exclude shapes with vertices that are not finite instead of repairing them", of="cleaning")
    close_holes: bool = reading(False, "close every hole by a fan of triangles", of="cleaning")
    label: int | str | None = reading(None,
        "the files are label volumes (NIfTI, MGH): the surface of this label, or several: 1,2",
        check=check_label, of="cleaning", more='Or of ``"all"``, see :func:`s4a.read_labels`')
    reflect: str | list[str] | None = reading(None,
        "shapes to mirror: their names, with commas; COLUMN=VALUE of the table; or auto",
        more="x becomes -x in the coordinates of their files, and triangles are turned over, so "
        "that left and right ones are of one hand.  A column may also have 1 and 0; ``auto`` "
        "are those of the rarer hand by ICP of pairs, as they are and mirrored "
        "(:func:`s4a.input.chirality.mirrored_shapes`).  ``/report`` says of each whether it was")
    table: Path | str | None = reading(None,
        "CSV with a column 'shape', covariates and groups, for the statistics",
        more="See :func:`s4a.input.subjects.read_table`; they become ``/subjects``.  Nothing "
        "else depends on it.  Without one, a table given to an earlier run stays")
    landmarks: Path | str | None = reading(None,
        "folder of landmark files named as the shapes, which guide registration",
        more="3D Slicer (.mrk.json), CSV or MeshLab (.pp), for some or all shapes.  Those of "
        "one name guide and pull registration, see :func:`s4a.with_landmarks`, which gives them "
        "to meshes in memory")
    features: str | list[str] | None = reading(None,
        "fields that guide registration, with commas: sulc is a.sulc.npy beside a.ply",
        more="Or a.sulc, or a property of PLY (:func:`s4a.input.annotations.files_beside`); see "
        ":func:`s4a.with_features`, which gives them to meshes in memory")
    method: str = network("rematch",
        "low resolution by remeshing, or by the local functions of SCALABLE",
        choices=("rematch", "scalable"), section="4.1", see="method/scalable", of="low resolution",
        pair=True,
        more="The study has the same nodes and variables but for U, and all that takes one "
        "takes it; what is called a coarse mesh are then samples, joined where their cells "
        "meet.  ``lift`` and ``wrap`` need a coarse mesh and are refused")
    n_coarse: int = network(N_COARSE, "vertices of the low-resolution meshes", least=100,
        fast=3000, section="4.1", of="low resolution", pair=True, more="Or samples of SCALABLE")
    wrap: bool = network(False, "wrap the shapes watertight before they are remeshed",
        of="low resolution")
    lift: bool = network(False,
        "eigenfunctions of the original meshes, nearly, instead of U Phi", paper=False,
        section="eq. 4, 7, 8", instead="$U \\phi$", see="method/refined_eigenfunctions", of="low resolution",
        pair=True,
        more="By inverse iteration, in eq. 4, 7 and the smoothing of eq. 8.  They are kept in "
        "``/coarse``: 40 MB for 100,000 vertices")
    k_init: int = network(20, "size of the initial functional maps", least=4, section="5.1",
        pair=True)
    k: int = network(100, "size of the refined functional maps", least=4, section="5.1",
        of="low resolution", pair=True)
    n_pairs: int = network(500, "pairs of the network, each with maps both ways", least=1,
        section="5.1", more="All pairs where there are fewer")
    init: str = network("dense",
        "initial maps from all nearest neighbours, or the paper's fit on 10 landmarks",
        choices=("dense", "landmarks"), paper="landmarks", section="4.1, steps 3 and 4",
        instead="initial map fitted on 10 landmarks", see="method/initial_map", of="initial maps",
        pair=True,
        more="The former after ICP; in far poses the best of several maps, see "
        ":func:`s4a.match_pair`")
    ahead: str = network("always",
        "a step of ZoomOut without growth for all initial maps, for those of the network alone, "
        "or none", choices=("always", "network", "never"), paper="network", section="4.2",
        instead="a step of ZoomOut ahead of Consistent ZoomOut", see="method/initial_map",
        of="initial maps", given_as="never".__ne__, pair=True,
        more="All are also those of a pair that is matched on its own (4.1)")
    step: int = network(5, "growth of the maps per round of Consistent ZoomOut", least=1,
        section="4.2", pair=True)
    n_latent: int | None = network(None, "dimension of the latent space; k by default", least=2,
        section="eq. 3")
    weights: str = network("cycles", "of the maps: by how far their cycles close, or 1",
        choices=("cycles", "equal"), section="eq. 3", see="method/network")
    n_samples: int = network(N_SAMPLES,
        "vertices at which the network looks for matches; 0 for all", paper=0, fast=500,
        section="eq. 3", instead="for all vertices in every round", see="method/latent",
        of="initial maps",
        more="In the step ahead of near poses, too, which saves time; 2 k at least")
    wide: int = network(4, "its last iterations in which these look between the samples, too",
        paper=0, fast=0, section="eq. 3", see="method/latent")
    norm: str = network("h2", "norm that decides which shape is the median",
        choices=("h2", "h1", "frobenius", "h2_image", "h2_both"), section="eq. 5",
        more="See :func:`s4a.method.median.distance_to_identity`")
    keep_iterations: bool = network(False,
        "keep the maps and latent bases of every round of Consistent ZoomOut",
        more="They are ``/iterations``")
    template: str | None = registration(None,
        "name of the shape to register to; the median shape by default")
    how: str = registration("ours", "full resolution by eq. 7, or by eq. 3 and 4",
        choices=("ours", "standard"), section="4.2",
        more='Unless ``refine="intrinsic"`` that match is one candidate among others')
    refine: str = registration("elastic",
        "elastic iterations, joint ones, or the paper's spectral match alone",
        choices=("elastic", "joint", "intrinsic"), paper="intrinsic", section="eq. 7, 4",
        instead="the match as it is", see="method/elastic", of="registration", pair=True,
        more="A price on bending and distances across the surface; in far poses joint iterations "
        "before (:mod:`s4a.method.spectral_icp`).  Joint alone: the best of several ends")
    parts: bool = registration(True, "in far poses joint iterations turn every part on its own",
        paper=False, section="eq. 8", see="method/deform", of="registration", pair=True)
    full_resolution_iterations: int = registration(1,
        "iterations of ZoomOut of a single pair that look among all vertices of the source", paper=0,
        section="eq. 4", instead="after ZoomOut on coarse vertices", see="method/register",
        pair=True, more="External meshes of a transfer are single pairs, too")
    both: bool = registration(True, "match single pairs both ways and transfer along both",
        paper=False, section="6.2", instead="a template registered to a shape",
        see="analysis/transfer", pair=True, more="The mean of both, see :func:`s4a.register_pairs`")
    alignment: str = registration("fitted",
        "displacements after the transform that fits the registered surface best, or after that of "
        "ICP", choices=("fitted", "icp"), paper="icp", section="eq. 8",
        instead="after ICP (4.1, step 2)", see="method/deform", of="registration", pair=True)
    area_weighted: bool = registration(True,
        "weigh vertices by area in the projection of displacements", paper=False,
        section="after eq. 8", instead="$(U \\phi)^\\dagger$ as printed", see="method/deform",
        of="projection", pair=True)
    n_projected: int = registration(N_CENTRAL,
        "vertices, near coarse ones, by which that projection is computed; 0 for all", paper=0,
        section="after eq. 8", instead="on all vertices", see="method/shape", of="projection",
        pair=True)
    scale: bool = registration(False, "take size out of the displacements", of="registration")
    intersections: bool = quality(True, "count triangles that pass through others")
    flagged: str = quality("apart",
        "what becomes of flagged shapes: they stay apart, or the run stops",
        choices=("apart", "stop"),
        more="Such are shapes mirrored or of another unit.  Apart they are placed beside the "
        "network of all others and registered, so that nothing changes for these.  A run stops "
        "before the long stages")
    include_flagged: bool = quality(False, "take flagged shapes into modes and statistics")
    # fmt: on

    def __post_init__(self):
        settings = apply_preset(self.preset, vars(self), PRESETS)
        for name in DECLARED:
            value = check(name, settings.get(name, getattr(self, name)))
            object.__setattr__(self, name, value)
        if self.k < self.k_init:
            raise ValueError(f"k must be at least k_init = {self.k_init}; found {self.k}")
        if self.n_latent is not None and self.n_latent > self.k:
            raise ValueError(f"n_latent must be at most k = {self.k}; found {self.n_latent}")
        # pairs, of any k, take no notice of a default
        if self.n_samples != (PRESETS[None] | PRESETS[self.preset])["n_samples"]:
            self.check_n_samples()
        wrong = [name for name in self.feature_names if not FEATURE.fullmatch(name)]
        if wrong:
            raise ValueError(f"features need names of letters, digits, _ and -, found {wrong[0]!r}")
        self._check_together()

    def _check_together(self):
        """ValueError where an option leaves another without a meaning."""
        without = [name for name in WITHOUT_MESH if getattr(self, name)]
        why = ""
        if self.features is not None and self.label is not None:
            why = (
                "features= are fields of the vertices of meshes, and label= makes meshes of "
                "volumes, whose vertices nobody knows before"
            )
        elif self.landmarks is not None and self.refine != "elastic":
            why = f"landmarks pull elastic iterations, and refine={self.refine!r} makes none"
        elif self.method == "scalable" and without:
            why = (
                f"method='scalable' has no coarse mesh, and {without[0]}=True "
                f"{WITHOUT_MESH[without[0]]}"
            )
        elif self.include_flagged and self.flagged == "stop":
            why = (
                "include_flagged=True takes flagged shapes in and flagged='stop' ends the run "
                "where there are any"
            )
        if why:
            raise ValueError(f"{why}: leave out one of both")

    def check_n_samples(self) -> None:
        """ValueError where Consistent ZoomOut would have too few spread vertices for k."""
        least = min(PER_FUNCTION * self.k, self.n_coarse)
        if 0 < self.n_samples < least:
            raise ValueError(
                f"n_samples must be 0, for all vertices, or at least {least}, for k = {self.k}; "
                f"found {self.n_samples}"
            )

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

    def of(self, step: str) -> dict[str, Any]:
        """The options that the functions of a step take as keywords.

        Parameters
        ----------
        step : {"cleaning", "low resolution", "initial maps", "projection", "registration"}

        Examples
        --------
        >>> import s4a
        >>> s4a.Options().of("projection")
        {'area_weighted': True, 'n_projected': 25000}
        """
        given = {}
        for name, one in DECLARED.items():
            if one.metadata["of"] == step:
                given_as = one.metadata["given_as"] or (lambda value: value)
                given[name] = given_as(getattr(self, name))
        return given

    @property
    def feature_names(self) -> list[str]:
        """Names of the fields that guide registration."""
        return self.features.split(",") if isinstance(self.features, str) else []

    def changed(self, given: dict[str, Any]) -> Self:
        """These options with some given otherwise; a `preset` that is given sets its own again.

        What the preset before it set stands as the default again.

        Raises
        ------
        ValueError
            When one is outside its range, or contradicts the preset, the given or the own.

        Examples
        --------
        >>> import s4a
        >>> options = s4a.Options(k=50).changed({"preset": "paper"})
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
            unset = dict.fromkeys([*PRESETS["paper"], *PRESETS[own], *PRESETS.get(new, ())])
        return replace(self, **unset | given)

    @classmethod
    def from_report(cls, study: "xr.DataTree | xr.Dataset") -> Self:
        """The options of a study, or of its ``/report``; the default of one that it does not name.

        Examples
        --------
        >>> import s4a
        >>> import xarray as xr
        >>> from s4a.options import with_options
        >>> options = s4a.Options(k=50, components=2, template="None")
        >>> report = xr.Dataset(attrs=with_options({}, vars(options)))
        >>> s4a.Options.from_report(report) == options
        True
        """
        return cls(**kept_options(study))


DECLARED: dict[str, Field[Any]] = {one.name: one for one in fields(Options)}
# options that a preset sets: one that is not given is None until then
PRESETS: dict[str | None, dict[str, Any]] = {
    None: {
        name: one.metadata["default"] for name, one in DECLARED.items() if one.metadata["presets"]
    },
} | {
    preset: {
        name: one.metadata["presets"][preset]
        for name, one in DECLARED.items()
        if preset in one.metadata["presets"]
    }
    for preset in ("paper", "fast")
}


def kept_options(study: "xr.DataTree | xr.Dataset") -> dict[str, Any]:
    """The options that the report of a study names, or a report itself."""
    report = study["report"] if "report" in study else study
    kept = json.loads(report.attrs.get("options", "{}"))
    return {name: kept[name] for name in DECLARED if name in kept}


def with_options(attrs: Mapping[Any, Any], options: Mapping[str, Any]) -> dict[Any, Any]:
    """The attributes of a report with these options in place of those that it has."""
    kept = json.loads(attrs.get("options", "{}"))
    return {**attrs, "options": json.dumps({**kept, **options})}


def given_options(
    given: dict[str, Any], of: Options | None = None, *, pair: bool = False
) -> Options:
    """The options from keywords, in place of some `of` these where there are any.

    Raises
    ------
    TypeError
        When one is given that there is not, or that is none of a `pair`.
    ValueError
        When one is outside its range, or contradicts the preset.

    Examples
    --------
    >>> from s4a.options import given_options
    >>> given_options({"k": 50, "n_corse": 300})
    Traceback (most recent call last):
    TypeError: unexpected option n_corse; did you mean n_coarse?
    """
    from s4a.seeds import seeded

    given = seeded(given)
    known = [name for name, one in DECLARED.items() if one.metadata["pair"] or not pair]
    for name in given.keys() - set(known):
        near = [] if name in DECLARED else difflib.get_close_matches(name, known, 1)
        said = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
        raise TypeError(f"unexpected option {name}{' of a pair' if pair else ''}; {said}")
    return Options(**given) if of is None else of.changed(given)


def _entry(one):
    """An option in the words of the docstring."""
    told = one.metadata
    kinds = " or ".join(kind.__name__ for kind in get_args(one.type) or (one.type,))
    kinds = kinds.replace("NoneType", "None")
    kind = f"{{{', '.join(map(repr, told['choices']))}}}" if told["choices"] else kinds
    presets = "".join(f", {name} {value!r}" for name, value in told["presets"].items())
    text = f"{told['help'][0].upper()}{told['help'][1:]}"
    text += f" ({told['section']})." if told["section"] else "."
    text += f"  {told['more']}." if told["more"] else ""
    module = told["see"].replace("/", ".")
    text += f"  See :mod:`s4a.{module}`." if module else ""
    lines = textwrap.wrap(text, 92, break_on_hyphens=False, break_long_words=False)
    return "\n".join(
        [f"{one.name} : {kind}, default {told['default']!r}{presets}", *(f"    {x}" for x in lines)]
    )


if Options.__doc__:  # not with python -OO
    told = "\n".join(map(_entry, DECLARED.values()))
    Options.__doc__ = Options.__doc__.replace("{options}", textwrap.indent(told, "    ").lstrip())
