"""Options of an analysis (4, 5.1), each declared once.

A field of :class:`Options` declares type, range, default, preset values and help of an option.  The
validation, the presets, the command-line flags, the attributes of ``/report``, the docstring and
the table of differences from the paper are derived from it.  To add an option, add a field.
"""

import difflib
import inspect
import json
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import partial
from importlib.util import find_spec
from numbers import Integral
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Self, get_args

if TYPE_CHECKING:  # imported when they are first needed, so that a command starts at once
    import xarray as xr

N_COARSE = 6000  # vertices of a low-resolution mesh, unless a preset sets it
N_SAMPLES = 1000  # farthest-point samples at which Consistent ZoomOut searches
N_CENTRAL = 25_000  # vertices used to project a field onto the eigenfunctions
PER_FUNCTION = 2  # least number of samples per function, for a stable least-squares fit
MILLIMETRES = {"um": 0.001, "mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}  # units of length
FEATURE = re.compile(r"[A-Za-z0-9_-]{1,100}")  # valid in file names
# options that method="scalable" does not support, and why
WITHOUT_MESH = {
    "refined_eigenfunctions": "refines its eigenfunctions",
    "wrap": "remeshes another surface, on which the local functions are not defined",
}


def option(
    default: Any,
    *,
    group: str,
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
    """Declare an option as a dataclass field with metadata.

    Its help, the first sentence, and further ones are in the docstring of :class:`Options`.

    Parameters
    ----------
    default : object
        Default value, unless a preset sets another.
    group : str
        Group under which the command line shows it.
    choices : tuple of str
        Valid strings.
    least : int
        Smallest valid number.
    check : callable, optional
        Validates and converts the value, in place of `choices` and `least`.
    paper, fast : object, optional
        Values in these presets.
    section, instead, see : str
        Section of the paper, what the paper does there, and the module of S4A.
    of : str
        Step whose functions take the option as a keyword, see :meth:`Options.of`.
    given_as : callable, optional
        Converts the value of the option to that of the keyword.
    pair : bool
        Whether the option also applies to single pairs.
    """
    meta = {name: value for name, value in locals().items() if name not in ("paper", "fast")}
    meta["presets"] = {
        name: value for name, value in (("paper", paper), ("fast", fast)) if value is not MISSING
    }
    return field(default=None if meta["presets"] else default, metadata=meta)


# of each group
reading = partial(option, group="input")
network = partial(option, group="network")
registration = partial(option, group="registration")
quality = partial(option, group="quality control")
computing = partial(option, group="computing")


def check_components(components: Any) -> str | int:
    """Return `components`; raise ValueError unless "largest", "all" or a positive number."""
    is_number = isinstance(components, Integral) and not isinstance(components, bool)
    if is_number and components >= 1:
        return int(components)
    if isinstance(components, str) and components in ("largest", "all"):
        return components
    raise ValueError(
        f'components needs to be "largest", "all" or a number from 1; found {components!r}'
    )


def check_unit(unit: Any) -> str:
    """Return a unit of length; raise ValueError unless it is one of :data:`MILLIMETRES`."""
    if unit not in MILLIMETRES:
        raise ValueError(f"unit must be one of {', '.join(MILLIMETRES)}; found {unit!r}")
    return str(unit)


def check_label(label: Any) -> int | str | None:
    """Return a label in normal form: a number, several as ``"1,2"``, ``"all"``, or None.

    Raises
    ------
    ValueError
        If the label is invalid, or scikit-image is not installed.

    Examples
    --------
    >>> from s4a.options import check_label
    >>> check_label(17), check_label([2, 1]), check_label("1,2"), check_label("all")
    (17, '1,2', '1,2', 'all')
    """
    if label is None:
        return None
    is_several = isinstance(label, Iterable) and not isinstance(label, str)
    text = ",".join(map(str, label)) if is_several else str(label)
    is_numbers = re.fullmatch(r" *[-+]?\d+ *(, *[-+]?\d+ *)*", text)
    numbers = sorted({*map(int, text.split(","))}) if is_numbers else [0]
    if text != "all" and 0 in numbers:
        raise ValueError(
            f"label needs a number other than 0, several (1,2) or 'all'; found {label!r}"
        )
    if find_spec("skimage") is None:
        raise ValueError(
            "surfaces from label volumes need scikit-image, which is not installed; "
            "run: pip install 's4a[labels]'"
        )
    if text == "all":
        return text
    return numbers[0] if len(numbers) == 1 else ",".join(map(str, numbers))


def check(name: str, value: Any) -> Any:
    """Return a validated value of an option in normal form.

    Raises
    ------
    ValueError
        If the value is invalid; the message names the valid ones.

    Examples
    --------
    >>> from s4a.options import check
    >>> check("init", "landmark")
    Traceback (most recent call last):
    ValueError: init must be one of 'dense', 'landmarks', 'wave_kernels'; found 'landmark'
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
    """Return the options that presets set, with `given` values other than None unchanged.

    Options that the chosen preset does not set come from the default preset, ``None``.

    Raises
    ------
    ValueError
        If the preset is unknown, or contradicts a given value.

    Examples
    --------
    >>> from s4a.options import PRESETS, apply_preset
    >>> apply_preset("paper", {"wrap": None}, PRESETS)["area_weighted"]
    False
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
                "leave out one of the two"
            )
        settings[name] = value if own is None else own
    return settings


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of :func:`s4a.analyse`, completed by those of the preset.

    Parameters
    ----------
    preset
        'paper' switches off all additions to the published method; 'fast' halves the time.
        The default, None, uses all additions.  Errors of 'fast' are about a tenth larger
        (``benchmarks/cheaper.py``).  A value that contradicts the preset is refused.  To change one
        entry, pass ``Options(**PRESETS['paper'] | {'refine': 'elastic'})``.
    seed
        Seed of all random numbers.
        ``rng``, an integer or a ``numpy.random.Generator``, can replace it.
    pattern
        Read only files whose name matches a pattern, such as '*brain*'.
    components
        Connected components to keep of each mesh: 'largest', 'all' or a number.
    strict
        Exclude shapes with non-finite vertices instead of repairing them.
    close_holes
        Close each hole with a fan of triangles.
    label
        Extract the surface of this label, or of the union of several (1,2), from label volumes
        (NIfTI, MGH, NRRD).
        ``"all"`` means every label but 0, see :func:`s4a.read_labels` for the formats.  By default
        the files are meshes.
    coordinate_system
        Coordinate system of files that state none: RAS, LPS or 'surface RAS, c_ras X Y Z'.
        Files of different systems are converted to the most frequent one if all are known, and
        refused otherwise (:mod:`s4a.input.coordinates`).  What a file states is never overridden.
    unit
        Unit of files that state none: um, mm, cm, m or in.
    reflect
        Shapes to mirror: names separated by commas, COLUMN=VALUE of the table, or 'auto'.
        Mirroring maps x to -x in the coordinates of the file and reverses the triangles, so that
        left and right shapes get the same chirality.  A column of yes and no needs no value.
        ``auto`` mirrors the shapes of the rarer chirality, found by pairwise ICP of the shapes and
        of their mirror images (:func:`s4a.input.chirality.mirrored_shapes`).  ``/report`` says for
        each shape whether it was mirrored.
    table
        CSV file with a column 'shape', covariates and groups for the statistics.
        The columns are stored in ``/subjects``; :func:`s4a.input.subjects.read_table` describes the
        format.  Only ``reflect`` and the statistics use the table.  Without a table, the table of
        an earlier run is kept.
    landmarks
        Folder of landmark files, named as the shapes, that guide alignment and elastic
        registration.
        The formats are those of :func:`s4a.input.annotations.read_landmarks`.  Shapes without a
        file have no landmarks.  Landmarks of two shapes are paired by name.
        :func:`s4a.with_landmarks` adds landmarks to a mesh in memory.
    features
        Names of scalar fields that guide registration, separated by commas; the field sulc of a.ply
        is read from a.sulc.npy.
        A file a.sulc or a property of the PLY file are read, too
        (:func:`s4a.input.annotations.feature_files`).  :func:`s4a.with_features` adds fields to a
        mesh in memory.
    method
        Low-resolution shapes: remeshed surfaces (rematch) or local functions (scalable).
        The methods are ReMatching and SCALABLE.  Both give the same nodes and variables, but
        SCALABLE has no U.  Its coarse vertices are samples, joined by an edge where their cells
        meet.  ``refined_eigenfunctions`` and ``wrap`` cannot be used with SCALABLE.
    n_coarse
        Number of vertices of the low-resolution meshes.
        The meshes have between 95 and 110 % of this number, usually 95 %: 5,700 of 6,000, since the
        rest is for repairs of the topology.  With SCALABLE it is the number of samples.
    sampling
        Samples of the low-resolution meshes: farthest points in position and normal (normals), or,
        as in ReMatching, along the surface, with U from closest points in space (geodesic).
        Geodesic samples ignore curvature, and U can then cross thin walls.
    wrap
        Wrap the shapes in a watertight surface before remeshing.
    refined_eigenfunctions
        Use refined full-resolution eigenfunctions instead of U Phi.
        U Phi interpolates the eigenfunctions of the coarse mesh.  The refined ones approximate
        those of the original mesh by one step of inverse iteration.  They are used in eq. 4, in eq.
        7 and in the smoothing of eq. 8.  ``/coarse`` stores them, 40 MB for 100,000 vertices.
    k_init
        Size of the initial functional maps.
    k
        Size of the refined functional maps.
    n_pairs
        Number of pairs in the network, each with maps in both directions.
        All pairs are used if there are fewer.
    alignment
        Rigid alignment: the best of several results of ICP in position and normal (search), plain
        ICP from the pose of the files (icp), or that pose, with centroids aligned (given).
        The search starts at the principal axes, so its result does not depend on the pose of the
        files.  A shape that fits others equally well in two poses is flagged.  Landmarks replace
        the search and the pose from which plain ICP starts.  Use 'given' for aligned data.
    init
        Initial maps from nearest neighbours of all vertices (dense), from 10 landmarks (landmarks),
        or as in pyFM from wave kernels of the shapes and of these landmarks (wave_kernels).
        Nearest neighbours are found after ICP.  If poses differ a lot, the best of several initial
        maps is used.
    initial_refinement
        Refine initial maps by one ZoomOut iteration: in the network and in s4a.match_pair (always),
        in the network only (network), or never.
        The iteration does not change the size of the map.  Single pairs are matched by
        :func:`s4a.match_pair` (4.1).
    step
        Eigenfunctions added in each iteration of ZoomOut.
    n_latent
        Dimension of the latent space; by default k.
    weights
        Weights of the maps: from their mean cycle errors (cycles), as in pyFM from errors by a
        linear program (linear_program), or all 1 (equal).
    isometric
        Before each latent basis of Consistent ZoomOut, replace both maps of a pair by the more
        orthogonal one and its transpose, as pyFM does.
        The maps are then closer to area-preserving, so the energies of eq. 5 are smaller.  In pyFM
        this is ``isometric`` of ``FMN.zoomout_refine``, which is True by default.
    n_samples
        Number of farthest-point samples that Consistent ZoomOut matches; 0 for all vertices.
        The number must be at least 2 k.  The initial refinement also uses the samples if pose
        differences are small.
    dense_iterations
        Final Consistent ZoomOut iterations that also search the vertices around each match.
        Matches between samples alone are only as accurate as the spacing of the samples.  With
        ``n_samples=0`` all vertices are searched anyway.
    norm
        Norm that selects the median shape: the shape difference with the smallest norm.
        'frobenius' weights all eigenfunctions equally.  'h1' gives fine detail less weight, and
        'h2' even less.  'h2_image' gives fine detail more weight.  'h2_both' gives fine detail less
        weight in the domain and more weight in the image.
        :func:`s4a.method.median.distance_to_identity` has the formulas.
    keep_iterations
        Store the maps, latent bases and matches of every iteration of Consistent ZoomOut.
        They are the nodes of ``/iterations``.  The descriptors of initial maps are in ``/network``.
        :func:`s4a.match_pair` has the same option for the iterations of ZoomOut.
    template
        Name of the shape to register to; by default the median shape.
    dense_match
        Full-resolution match by the latent bases (eq. 7) or by functional maps (eq. 3 and 4).
        Unless ``refine="intrinsic"``, this match is one of several initialisations.
    refine
        Refinement of the match: elastic iterations, iterated spectral non-rigid ICP, or none as in
        the paper (intrinsic).
        Elastic iterations penalise bending and stretch.  If poses differ a lot, spectral non-rigid
        ICP comes first (:mod:`s4a.method.spectral_icp`).  With 'spectral_icp' the best of several
        results is kept.
    articulated
        If poses differ a lot, spectral non-rigid ICP fits a separate rigid transform to each part,
        such as a limb.
        Otherwise one rigid transform applies to the whole shape.
    full_resolution_iterations
        s4a.match_pair and transfer only: ZoomOut iterations that search all source vertices.
        They follow ZoomOut on coarse vertices.  Also used when an external mesh is matched to the
        template.
    bidirectional
        Transfer only: match pairs in both directions and average the results.
        It is an option of :func:`s4a.register_pairs`.
    displacement_alignment
        Rigid alignment to the template before displacements are computed: best fit of the
        registered surface (fitted), or the initial alignment (initial).
        With 'initial', eq. 8 holds as printed in the paper.
    area_weighted
        Weight vertices by area when displacements are projected onto U Phi.
    n_projected
        Number of vertices used to project displacements onto U Phi; 0 for all.
        Vertices near coarse vertices are used.
    remove_size
        Align with scaling, so that displacements do not contain size.
    intersections
        Count self-intersecting triangles: those that intersect others of the same shape.
    quality_control
        Suspect (flagged) shapes, such as mirrored ones, are excluded, the run stops, or all shapes
        are used (off).
        A flagged shape, such as a mirrored one or one in another unit, is left out of the network
        and of the modes.  It is registered afterwards, with the results of the others held fixed.
        With 'stop' the run ends before the long stages.  With 'off' all shapes are in the network
        and the modes, each can be the median, shapes are not compared with each other, and what
        cleaning, alignment and registration find are warnings.
    include_flagged
        Include suspect (flagged) shapes in the modes and statistics.

    Raises
    ------
    ValueError
        If a value is invalid or contradicts the preset; the message names the valid ones.

    Examples
    --------
    >>> import s4a
    >>> options = s4a.Options(preset="paper", k=50)
    >>> options.refine, options.k, options.k_init
    ('intrinsic', 50, 20)
    >>> s4a.Options(preset="fast", n_samples=0)
    Traceback (most recent call last):
    ValueError: preset 'fast' sets n_samples=500; found n_samples=0: leave out one of the two
    """

    # fmt: off
    preset: str | None = computing(None, choices=("paper", "fast"), pair=True)
    seed: int = computing(0, of="low resolution", pair=True)
    pattern: str | None = reading(None)
    components: str | int = reading("largest", check=check_components, of="cleaning")
    strict: bool = reading(False, of="cleaning")
    close_holes: bool = reading(False, of="cleaning")
    label: int | str | None = reading(None, check=check_label, of="cleaning")
    coordinate_system: str | None = reading(None, of="cleaning", pair=True)
    unit: str | None = reading(None, check=check_unit, of="cleaning", pair=True)
    reflect: str | list[str] | None = reading(None)
    table: Path | str | None = reading(None)
    landmarks: Path | str | None = reading(None)
    features: str | list[str] | None = reading(None)
    method: str = network("rematch", choices=("rematch", "scalable"), section="4.1",
        see="method/scalable", of="low resolution", pair=True)
    n_coarse: int = network(N_COARSE, least=100, fast=3000, section="4.1", of="low resolution",
        pair=True)
    sampling: str = network("normals", choices=("normals", "geodesic"), section="4.1, step 1",
        see="method/remesh", of="low resolution", pair=True)
    wrap: bool = network(False, of="low resolution")
    refined_eigenfunctions: bool = network(False, paper=False, section="eq. 4, 7, 8",
        instead="$U \\phi$", see="method/refined_eigenfunctions", of="low resolution", pair=True)
    k_init: int = network(20, least=4, section="5.1", pair=True)
    k: int = network(100, least=4, section="5.1", of="low resolution", pair=True)
    n_pairs: int = network(500, least=1, section="5.1")
    alignment: str = network("search", choices=("search", "icp", "given"), paper="icp",
        section="4.1, step 2", instead="ICP from the pose of the files", see="method/alignment",
        of="initial maps", pair=True)
    init: str = network("dense", choices=("dense", "landmarks", "wave_kernels"), paper="landmarks",
        section="4.1, steps 3 and 4", instead="initial map fitted to 10 landmarks",
        see="method/initial_map", of="initial maps", pair=True)
    initial_refinement: str = network("always", choices=("always", "network", "never"),
        paper="network", section="4.2", instead="one ZoomOut iteration before Consistent ZoomOut",
        see="method/initial_map", of="initial maps", given_as="never".__ne__, pair=True)
    step: int = network(5, least=1, section="4.2", of="Consistent ZoomOut", pair=True)
    n_latent: int | None = network(None, least=2, section="eq. 3", of="Consistent ZoomOut")
    weights: str = network("cycles", choices=("cycles", "linear_program", "equal"), section="eq. 3",
        see="method/network", of="Consistent ZoomOut")
    isometric: bool = network(False, section="4.2", see="method/latent", of="Consistent ZoomOut")
    n_samples: int = network(N_SAMPLES, paper=0, fast=500, section="eq. 3",
        instead="for all vertices in every iteration", see="method/latent", of="initial maps")
    dense_iterations: int = network(4, paper=0, fast=0, section="eq. 3", see="method/latent",
        of="Consistent ZoomOut")
    norm: str = network("h2", choices=("h2", "h1", "frobenius", "h2_image", "h2_both"),
        section="eq. 5", of="Consistent ZoomOut")
    keep_iterations: bool = network(False, of="Consistent ZoomOut")
    template: str | None = registration(None)
    dense_match: str = registration("latent", choices=("latent", "fmap"), section="4.2")
    refine: str = registration("elastic", choices=("elastic", "spectral_icp", "intrinsic"),
        paper="intrinsic", section="eq. 7, 4", instead="the match as it is", see="method/elastic",
        of="registration", pair=True)
    articulated: bool = registration(True, paper=False, section="eq. 8", see="method/deform",
        of="registration", pair=True)
    full_resolution_iterations: int = registration(1, paper=0, section="eq. 4",
        instead="after ZoomOut on coarse vertices", see="method/register", pair=True)
    bidirectional: bool = registration(True, paper=False, section="6.2",
        instead="a template registered to a shape", see="study/pair", pair=True)
    displacement_alignment: str = registration("fitted", choices=("fitted", "initial"),
        paper="initial", section="eq. 8", instead="after ICP (4.1, step 2)", see="method/deform",
        of="registration", pair=True)
    area_weighted: bool = registration(True, paper=False, section="after eq. 8",
        instead="$(U \\phi)^\\dagger$ as printed", see="method/deform", of="projection", pair=True)
    n_projected: int = registration(N_CENTRAL, paper=0, section="after eq. 8",
        instead="on all vertices", see="method/shape", of="projection", pair=True)
    remove_size: bool = registration(False, of="registration")
    intersections: bool = quality(True)
    quality_control: str = quality("exclude", choices=("exclude", "stop", "off"), paper="off",
        section="4.2", instead="all shapes", see="study/quality_control")
    include_flagged: bool = quality(False)
    # fmt: on

    def __new__(cls, **given: Any) -> Self:
        """Return the options; TypeError if one is unknown."""
        check_known(given)
        return super().__new__(cls)

    def __post_init__(self):
        settings = apply_preset(self.preset, vars(self), PRESETS)
        for name in DECLARED:
            value = check(name, settings.get(name, getattr(self, name)))
            object.__setattr__(self, name, value)
        if self.k < self.k_init:
            raise ValueError(f"k must be at least k_init = {self.k_init}; found {self.k}")
        if self.n_latent is not None and self.n_latent > self.k:
            raise ValueError(f"n_latent must be at most k = {self.k}; found {self.n_latent}")
        # single pairs, which may have a larger k, ignore the default
        if self.n_samples != (PRESETS[None] | PRESETS[self.preset])["n_samples"]:
            self.check_n_samples()
        wrong = [name for name in self.feature_names if not FEATURE.fullmatch(name)]
        if wrong:
            raise ValueError(f"features need names of letters, digits, _ and -, found {wrong[0]!r}")
        self._check_together()

    def _check_together(self):
        """Raise ValueError if two options exclude each other."""
        without = [name for name in WITHOUT_MESH if getattr(self, name)]
        why = ""
        if self.features is not None and self.label is not None:
            why = (
                "features= are fields on the vertices of meshes, and label= extracts meshes from "
                "volumes, whose vertices are not known before"
            )
        elif self.method == "scalable" and without:
            why = (
                f"method='scalable' has no coarse mesh, and {without[0]}=True "
                f"{WITHOUT_MESH[without[0]]}"
            )
        elif self.method == "scalable" and self.sampling != "normals":
            why = f"method='scalable' has samples of its own, and sampling={self.sampling!r} others"
        elif self.include_flagged and self.quality_control == "stop":
            why = (
                "include_flagged=True includes flagged shapes and quality_control='stop' ends the "
                "run if there are any"
            )
        if why:
            raise ValueError(f"{why}: leave out one of the two")

    def check_n_samples(self) -> None:
        """Raise ValueError if Consistent ZoomOut has too few samples for k."""
        least = min(PER_FUNCTION * self.k, self.n_coarse)
        if 0 < self.n_samples < least:
            raise ValueError(
                f"k = {self.k} needs n_samples = {least} or more, or n_samples = 0 for all "
                f"vertices; found {self.n_samples}"
            )

    def check_against(self, names: list[str]) -> None:
        """Raise ValueError if the template is unknown, or the pairs cannot connect the shapes."""
        if self.template is not None and self.template not in names:
            raise ValueError(
                f"template {self.template!r} is not one of the shapes: {', '.join(names)}"
            )
        n = len(names)
        if self.n_pairs < n - 1:
            raise ValueError(
                f"n_pairs = {self.n_pairs!r} cannot connect {n} shapes: give an integer from "
                f"{n - 1} (a tree) to {n * (n - 1) // 2} (all pairs)"
            )

    def of(self, step: str) -> dict[str, Any]:
        """Return the keyword arguments of the functions of a step.

        Parameters
        ----------
        step : str
            "cleaning", "low resolution", "initial maps", "Consistent ZoomOut", "projection" or
            "registration".

        Examples
        --------
        >>> import s4a
        >>> s4a.Options().of("projection")
        {'area_weighted': True, 'n_projected': 25000}
        """
        given = {}
        for name in names_of(step):
            given_as = DECLARED[name].metadata["given_as"] or (lambda value: value)
            given[name] = given_as(getattr(self, name))
        return given

    @property
    def feature_names(self) -> list[str]:
        """Names of the scalar fields that guide registration."""
        return self.features.split(",") if isinstance(self.features, str) else []

    def changed(self, given: dict[str, Any]) -> Self:
        """Return these options with the `given` ones replaced.

        A given `preset` replaces the values that the previous preset had set.

        Raises
        ------
        ValueError
            If a value is invalid or contradicts the preset.

        Examples
        --------
        >>> import s4a
        >>> options = s4a.Options(k=50).changed({"preset": "paper"})
        >>> options.k, options.refine
        (50, 'intrinsic')
        >>> options.changed({"n_samples": 500})
        Traceback (most recent call last):
        ValueError: preset 'paper' sets n_samples=0; found n_samples=500: leave out one of the two
        """
        unset: dict[str, None] = {}
        if "preset" in given:
            new, own = given["preset"] or "paper", self.preset or "paper"
            unset = dict.fromkeys([*PRESETS["paper"], *PRESETS[own], *PRESETS.get(new, ())])
        return replace(self, **unset | given)

    @classmethod
    def from_report(cls, study: "xr.DataTree | xr.Dataset") -> Self:
        """Return the options of a study or of its ``/report``, defaults where it names none.

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
# values of options that presets set; such an option is None until a preset is applied
PRESETS: dict[str | None, dict[str, Any]] = {
    None: {
        name: one.metadata["default"] for name, one in DECLARED.items() if one.metadata["presets"]
    }
} | {
    preset: {
        name: one.metadata["presets"][preset]
        for name, one in DECLARED.items()
        if preset in one.metadata["presets"]
    }
    for preset in ("paper", "fast")
}


def names_of(step: str) -> list[str]:
    """Return the names of the options of a step, see :meth:`Options.of`."""
    return [name for name, one in DECLARED.items() if one.metadata["of"] == step]


def kept_options(study: "xr.DataTree | xr.Dataset") -> dict[str, Any]:
    """Return the options stored in the report of a study, or in a report."""
    report = study["report"] if "report" in study else study
    kept = json.loads(report.attrs.get("options", "{}"))
    return {name: kept[name] for name in DECLARED if name in kept}


def with_options(attrs: Mapping[Any, Any], options: Mapping[str, Any]) -> dict[Any, Any]:
    """Return the attributes of a report with these options replaced."""
    kept = json.loads(attrs.get("options", "{}"))
    return {**attrs, "options": json.dumps({**kept, **options})}


def given_options(
    given: dict[str, Any], of: Options | None = None, *, pair: bool = False
) -> Options:
    """Return options from keyword arguments, or `of` with these replaced.

    Raises
    ------
    TypeError
        If an option is unknown, or does not apply to a single `pair`.
    ValueError
        If a value is invalid or contradicts the preset.

    Examples
    --------
    >>> from s4a.options import given_options
    >>> given_options({"k": 50, "n_corse": 300})
    Traceback (most recent call last):
    TypeError: unexpected option n_corse; did you mean n_coarse?
    """
    from s4a.seeds import seeded

    given = seeded(given)
    check_known(given, pair=pair)
    return Options(**given) if of is None else of.changed(given)


def check_known(given: Iterable[str], *, pair: bool = False) -> None:
    """Raise TypeError if a name is not that of an option, or of one of a single `pair`."""
    known = [name for name, one in DECLARED.items() if one.metadata["pair"] or not pair]
    for name in set(given) - set(known):
        near = [] if name in DECLARED else difflib.get_close_matches(name, known, 1)
        said = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
        raise TypeError(f"unexpected option {name}{' of a pair' if pair else ''}; {said}")


def _entry(one):
    """Entry of an option in the docstring."""
    meta = one.metadata
    kinds = " or ".join(kind.__name__ for kind in get_args(one.type) or (one.type,))
    kinds = kinds.replace("NoneType", "None")
    kind = f"{{{', '.join(map(repr, meta['choices']))}}}" if meta["choices"] else kinds
    presets = "".join(f", {name} {value!r}" for name, value in meta["presets"].items())
    text = f"{HELP[one.name][0].upper()}{HELP[one.name][1:]}"
    text += f" ({meta['section']})." if meta["section"] else "."
    text += f"  {NOTES[one.name]}" if NOTES[one.name] else ""
    module = meta["see"].replace("/", ".")
    text += f"  See :mod:`s4a.{module}`." if module else ""
    lines = textwrap.wrap(text, 92, break_on_hyphens=False, break_long_words=False)
    return "\n".join(
        [f"{one.name} : {kind}, default {meta['default']!r}{presets}", *(f"    {x}" for x in lines)]
    )


_DOCUMENTED = inspect.getdoc(Options) or ""
# of each option, from the docstring: the first sentence, for a flag, and further ones
HELP, NOTES = dict.fromkeys(DECLARED, ""), dict.fromkeys(DECLARED, "")
for name, text in re.findall(r"^(\w+)\n((?:    .+\n)+)", _DOCUMENTED, re.MULTILINE):
    if name in DECLARED:
        sentence, _, rest = text.strip().partition(".\n")
        sentence = " ".join(sentence.removesuffix(".").split())
        is_name = sentence[:2].isupper()
        HELP[name] = sentence if is_name else sentence[0].lower() + sentence[1:]
        NOTES[name] = " ".join(rest.split())
if any(HELP.values()):  # not with python -OO
    before, _, after = _DOCUMENTED.partition("preset\n")
    entries = "\n".join(map(_entry, DECLARED.values()))
    Options.__doc__ = before + entries + after[after.index("\n\nRaises") :]
