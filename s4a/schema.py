"""Table of all variables of a study: dims, unit and meaning.

Each step makes its output through :func:`variable`, so that names, dims and attributes are the same
everywhere, and checks its input through :func:`require`.  A variable that is not in the table does
not exist; extensions add rows by the entry points ``s4a.variables``.
"""

import logging
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from s4a.extensions import extensions

log = logging.getLogger(__name__)
Array = np.ndarray  # of numbers; its dims and kind stand in the docstring
INPUT = "unit of the input"
POSE = "pose"  # the kind of a flag for an ambiguous pose
INPUT2 = "squared unit of the input"
FIELD_UNIT = "unit of the field"
ONE = "1"
SHARE = "share of sqrt(area)"
UNIT_AREA = "1, for the surface scaled to unit area"
LARGEST_COUNT = 2**31 - 1  # of options that count, and of seeds: what every library takes

_UNITS = {
    "L": INPUT, "L2": INPUT2, "share": SHARE, "unit area": UNIT_AREA, "field": FIELD_UNIT
}  # fmt: skip


def _rows(text):
    """Parse rows ``name | dims | unit | long_name``; continuation lines are indented."""
    lines = [line for line in text.strip().replace("\n    ", " ").splitlines() if line[0] != "#"]
    cells = ([cell.strip() for cell in line.split("|", 3)] for line in lines)
    return {name: (dims, _UNITS.get(unit, unit), meaning) for name, dims, unit, meaning in cells}


# A new variable is a new row, next to those of its step; L is the unit of the input.  The file of a
# single shape lacks a leading dim `shape`.
ROWS: dict[str, tuple[str, str, str]] = _rows("""
# a mesh, original or coarse
position | vertex xyz | L | vertex position
corner_vertex | triangle corner | 1 | vertex at each corner of a triangle
file_vertex | vertex | 1 | index of the vertex in its file
vertex_of_file | file_vertex_index | 1 | vertex that a vertex of the file became, -1 if it was
    dropped
label | vertex | 1 | label of the vertex
landmark_name | landmark | 1 | name of the landmark
landmark_position | landmark xyz | L | position of the landmark
guide_name | guide | 1 | name of a landmark that guides registration
guide_position | guide xyz | L | its position on the surface
guide_triangle | guide | 1 | triangle of the mesh that contains it
guide_barycentric | guide corner | 1 | its barycentric weights in that triangle
guide_distance | guide | L | distance of the given position from the surface
guide_vertex | guide | 1 | coarse vertex nearest to it
feature_name | feature | 1 | name of a scalar field that guides registration
feature_weight | feature | 1 | weight of the field relative to the others
feature_value | vertex feature | 1 | its value, in its own unit
landmark_curve | landmark | 1 | curve that the landmark is on, in order along it; empty if none
landmark_closed | landmark | 1 | whether that curve is closed
# low resolution (4.1) and its spectrum (3.3)
vertex_area | vertex | L2 | lumped area of the vertex, the diagonal of A
edge_vertex | edge end | 1 | vertices at both ends of an edge
cotan_weight | edge | 1 | cotan weight of the edge, so that the Laplacian is A^-1 W
sample_vertex | vertex | 1 | vertex of the original mesh at the coarse vertex, -1 if none
coarse_vertex | original_vertex corner | 1 | coarse vertices that interpolate an original vertex:
    columns of U
coarse_weight | original_vertex corner | 1 | their barycentric weights: entries of U
# the same for SCALABLE (s4a.method.scalable), whose coarse vertices are samples
sample_cell | original_vertex | 1 | Voronoi cell of the original vertex: the nearest sample along
    edges
local_vertex | entry | 1 | original vertex in the support of a local function: row of an entry of U
local_sample | entry | 1 | sample at which the function is centred: column of that entry
local_weight | entry | 1 | value of the function there; the rows of U sum to 1
edge_mass | edge | L2 | integral of the product of two local functions: entry of U^T A U, whose rows
    sum to the vertex areas
eigenvalue | eigenpair | unit area | eigenvalue of the Laplace-Beltrami operator
eigenfunction | vertex eigenpair | unit area | eigenfunction, orthonormal in the vertex areas
refined_eigenfunction | original_vertex eigenpair | unit area | approximate eigenfunction of the
    original mesh, by one step of inverse iteration
# one pair (4.1)
match | vertex | 1 | on each vertex of the target, the matched vertex of the source
# metrics of a pair (5.1, eq. 9 - 11)
chamfer | | share | Chamfer distance of the source and the image of the target (eq. 9)
hausdorff | | share | Hausdorff distance of the source and the image of the target
hausdorff_paper | | share | the same as eq. 10 prints it: a sum, with 1/n on the second term
dirichlet | | 1 | Dirichlet energy of the image's coordinates, source of unit area; 2 if conformal
    (eq. 11)
coverage | | 1 | share of the source's area whose vertices are matched to
bijectivity | | share | round trip target, source, target along edges, mean
conformal_distortion | | 1 | log(s1 / s2) of the maps of triangles that do not collapse, median by
    area
area_distortion | | 1 | |log(area of image / area)| of them, surfaces of unit area, median by area
collapsed_share | | 1 | share of the target's area in triangles whose image has no area
geodesic_error | | share | distance along edges between matched and true vertex, mean
euclidean_error | | share | Euclidean distance between image and true position, mean
error_curve | threshold | 1 | share of the vertices with a geodesic error up to the threshold
label_accuracy | | 1 | share of the area with the correct label
label_dice | | 1 | Dice's overlap by area, mean over the labels of the target
landmark_error | | share | Euclidean distance between transferred and given landmarks, mean
# the network of maps (3.4)
source | pair | 1 | source shape of the map
target | pair | 1 | target shape of the map
fmap | pair eigenpair_target eigenpair_source | 1 | functional map, from functions on the source to
    functions on the target
fmap_initial | pair eigenpair_target_initial eigenpair_source_initial | 1 | functional map before
    Consistent ZoomOut
fmap_fitted | pair eigenpair_target_initial eigenpair_source_initial | 1 | functional map before the
    initial ZoomOut iteration (4.2)
pair_rotation | pair xyz xyz_2 | 1 | rotation R of ICP, source to target, between their frames (4.1,
    step 2)
pair_translation | pair xyz | share | translation t of ICP, source to target
landmark_of_source | pair landmark | 1 | coarse vertices of the source used as landmarks for the
    initial map (4.1, step 3)
landmark_of_target | pair landmark | 1 | coarse vertices of the target nearest to them after ICP
pair_residual | pair | share | residual of ICP: root mean square distance of nearest
    vertices, in both directions
descriptor_of_source | pair eigenpair_source_initial descriptor | 1 | coefficients of descriptors of
    the source, each of norm 1, to which the initial map is fitted (4.1, step 4)
descriptor_of_target | pair eigenpair_target_initial descriptor | 1 | the same of the target
descriptor_energy | pair | 1 | |C F - G|^2 of the fitted map, F and G the descriptors
laplacian_energy | pair | 1 | the other term of the fit, the penalty for a map that does not commute
    with the Laplacians
spectral_distance | shape shape_2 | 1 | root mean square difference of log eigenvalues, which chose
    pairs and reference
icp_residual | shape | share | residual of ICP onto the reference
weight | pair | 1 | weight of the map in the consistent latent basis, from its cycle error over all
    eigenfunctions
cycle_error | pair | 1 | mean |C_cycle - I|_F over the 3-cycles through the pair, first k_init
    eigenfunctions, divided by sqrt(k_init)
cycle_error_initial | pair | 1 | the same before Consistent ZoomOut
iteration_size | iteration | 1 | size of the maps in each iteration of ZoomOut
iteration_weight | iteration pair | 1 | weight of each map in each iteration
iteration_cycle_error | iteration pair | 1 | mean |C_cycle - I|_F over the 3-cycles through the
    pair, all eigenfunctions, divided by the root of their number: the weights follow from it
iteration_fmap | iteration eigenpair_target eigenpair_source | 1 | functional map of each iteration
    of ZoomOut; NaN beyond its size
iteration_match | iteration low_vertex | 1 | coarse vertex of the source that it matches to each
    coarse vertex of the target (eq. 2)
matched_source | matched | 1 | coarse vertices of the source matched by eq. 3, pair after pair
matched_target | matched | 1 | the coarse vertices of the target that they are matched to
matched_count | pair | 1 | number of matched vertices of each pair
# latent basis and median (3.4 - 3.6, eq. 3 and 5)
latent_basis | shape eigenpair latent | 1 | consistent latent basis Y of each shape
latent_eigenvalue | latent | unit area | eigenvalue of the latent (limit) shape
area_difference | shape latent latent_2 | 1 | area-based shape difference D = Y^T Y
conformal_difference | shape latent latent_2 | 1 | conformal shape difference
distance_to_limit | shape | 1 | distance |D_i - I| of each shape to the limit shape (eq. 5)
distance_by_norm | norm shape | 1 | the same in every interpretation of the norm of eq. 5
area_component | difference_component latent latent_2 | 1 | principal component of the area-based
    shape differences, of norm 1 (3.6)
conformal_component | difference_component latent latent_2 | 1 | the same of the conformal ones
area_score | shape difference_component | 1 | PCA scores of the area-based shape differences
conformal_score | shape difference_component | 1 | PCA scores of the conformal shape differences
area_variance_ratio | difference_component | 1 | share of variance of the area-based differences
conformal_variance_ratio | difference_component | 1 | share of variance of the conformal differences
# registration (eq. 6 - 8)
registered_match | shape vertex | 1 | vertex of the shape matched to each template vertex
displacement | shape vertex xyz | L | registered shape minus template, smoothed (eq. 8 with the
    other sign)
displacement_raw | shape vertex xyz | L | matched vertex of the aligned shape minus template vertex
rotation | shape xyz xyz_2 | 1 | rotation R of the alignment x -> s R x + t onto the template
translation | shape xyz | L | translation t of the alignment onto the template
scale | shape | 1 | scale s of the alignment onto the template
registered_match_low | shape low_vertex | 1 | coarse vertex of the shape matched to each coarse
    vertex of the template (eq. 6)
displacement_low | shape low_vertex xyz | L | matched vertex of the aligned coarse shape minus
    coarse template vertex (eq. 6)
displacement_coefficient | shape eigenpair xyz | L | coefficients of the displacement in the
    functions U Phi of the template (6.1)
icp_rotation | shape xyz xyz_2 | 1 | rotation R of ICP, shape to template or reference, between
    their frames (4.1, step 2)
icp_translation | shape xyz | share | translation t of that rigid transform
confidence | shape vertex | 1 | estimated share of comparable vertices with an error of at most 1 %
    of sqrt(area)
round_trip | shape vertex | share | cycle error: distance from the vertex to itself, mapped to the
    shape and back
distortion | shape vertex | 1 | log ratio of the vertex's share of the area, on the shape over on
    the template
initialisation | shape | 1 | initialisation of the registration that was kept
registration_error | shape | share | error score of the registration, lower is better: mean of round
    trip and distances between the surfaces
template_triangle | original_vertex | 1 | template triangle that contains the vertex of the shape
template_barycentric | original_vertex corner | 1 | barycentric weights in that triangle
# transfer along a registration (6.2)
label_share | vertex | 1 | share of the votes for the label of the vertex, 0 to 1
label_vote | vertex label_value | 1 | share of the votes for each label; rows sum to 1
field | vertex | 1 | scalar field
landmark_triangle | landmark | 1 | triangle of the mesh that contains the landmark
landmark_barycentric | landmark corner | 1 | barycentric weights of the landmark in that triangle
image_triangle | vertex | 1 | triangle of another shape that contains the image of the vertex
image_barycentric | vertex corner | 1 | barycentric weights of the image in that triangle
image_position | vertex xyz | L | image of the vertex on another shape
landmark_confidence | landmark | 1 | confidence of the match at the landmark, 0 to 1
landmark_distance | landmark | L | distance of the given landmark from its surface
landmark_disagreement | landmark | L | distance between the positions from different paths of
    transfer
# modes (6.1)
mean_displacement | vertex xyz | L | mean of the displacements
deformation | component vertex xyz | L | deformation of one standard deviation along the component
standard_deviation | component | L | standard deviation of the component (area-weighted RMS)
score | shape component | 1 | score of each shape, in standard deviations
reconstruction_error | shape | L | root mean square over the area of what the components do not
    describe
score_excluded | shape_excluded component | 1 | score, in standard deviations, of a flagged shape
    that was left out of the PCA
explained_variance_ratio | component | 1 | share of the variance at full resolution
explained_variance_ratio_low | component | 1 | share of the variance at low resolution, of smoothed
    matches (eq. 6)
explained_variance_ratio_raw | component | 1 | share of the variance at low resolution, of the
    matches without smoothing
# evaluation of the model, tests and outliers (6.1)
compactness | component | L2 | cumulative variance of the first components
compactness_error | component | L2 | its standard error
generalization | component | L | distance of a left-out shape to its reconstruction, mean over
    shapes
generalization_error | component | L | its standard error
generalization_surface | component | L | the same, from vertices to the surface
generalization_surface_error | component | L | its standard error
specificity | component | L | distance of a random shape of the model to the nearest shape
specificity_error | component | L | its standard error
specificity_surface | component | L | the same, from vertices to the surface
specificity_surface_error | component | L | its standard error
variance_ratio | component | 1 | share of the variance, in the basis of the baseline
variance_ratio_null | component | 1 | the same under permutation of every coefficient, mean
variance_ratio_null_95 | component | 1 | the same, 95th percentile
statistic | | 1 | test statistic
p_value | | 1 | p value of the permutation test
explained_share | vertex | 1 | share of the variation at the vertex that is explained (Pillai's
    trace)
p_vertex | vertex | 1 | p value of the vertex alone
p_family_wise | vertex | 1 | p value corrected for all vertices by the largest statistic
p_false_discovery | vertex | 1 | p value adjusted for the false discovery rate
effect_size | vertex | 1 | effect size
effect | vertex xyz | L | difference of the groups' means, or change per unit of the variable
intercept | vertex xyz | L | displacement at the mean of the variable
standard_score | shape | 1 | variable of the regression, centred, in standard deviations
mahalanobis | shape | 1 | Mahalanobis distance to the mean of all others
outlier_p | shape | 1 | p value of that distance for a normal population
left_out_error | shape | L | distance of the shape to its reconstruction by the model of all others
outlier | shape | 1 | whether one of the two is beyond its threshold
predicted | shape | 1 | class predicted while the shape was left out
accuracy | fold | 1 | balanced accuracy on the left-out shapes
# fields on the template
transferred_field | shape vertex | field | field of the shape, transferred to the template
# ground truth of a synthetic collection
reference_point | vertex xyz | 1 | point of the unit sphere that the vertex is the image of
true_score | shape true_mode | 1 | simulated score of each shape, in standard deviations
true_centre | true_region xyz | mm | centre of each localised field of the simulated modes
true_width | true_region | mm | standard deviation of its Gaussian
true_translation | true_mode true_region xyz | mm | its translation in each simulated mode
true_rotation | true_mode true_region xyz | rad | its rotation in each simulated mode
noise_centre | shape noise_region xyz | mm | centres of the noise and, last, of the tumour of each
    shape
noise_width | shape noise_region | mm | their widths
noise_translation | shape noise_region xyz | mm | their translations
landmark_reference | landmark xyz | 1 | point of the unit sphere that the landmark is the image of
# the comparison (Table 1, Fig. 3, Table 2)
algorithm_match | algorithm vertex | 1 | vertex of the source matched to each vertex of the target
algorithm_reverse | algorithm source_vertex | 1 | vertex of the target matched to each vertex of the
    source
algorithm_image | algorithm vertex xyz | L | position of the target's vertex on the source
algorithm_area_change | algorithm vertex | 1 | log ratio of the vertex's share of the area, after
    over before the map
algorithm_fmap | algorithm eigenpair_target eigenpair_source | 1 | refined functional map, from
    functions on the source to functions on the target
algorithm_fmap_initial | algorithm eigenpair_target_initial eigenpair_source_initial | 1 | initial
    functional map
algorithm_error | algorithm vertex | share | Euclidean distance between image and true position
true_position | vertex xyz | L | true position of the vertex on the source
true_match | vertex | 1 | vertex of the source nearest to the true position, -1 if unknown
block_seconds | algorithm pair block | s | CPU time of the block, of one core
collection_chamfer | algorithm dense_match shape | share | Chamfer distance between the shape and
    the image of the template (eq. 9)
collection_seconds | algorithm dense_match block | s | CPU time of the block for the whole
    collection, on one core
median_shape | algorithm | 1 | median shape (eq. 5)
# state of the files of a study
state | file | 1 | whole, damaged, missing, stale, left over or foreign, see s4a.verify
fault | file | 1 | fault of the file; empty if none
# plausibility (5.1): a shape alone and compared with its collection
descriptor_position | point xyz | 1 | sampled vertices of the shape, centred, of unit root mean
    square radius
descriptor_area | point | 1 | their shares of the area
descriptor_normal | point xyz | 1 | their normals
descriptor_asymmetry | point | 1 | distance of the shape's mirror image at the vertex
moment | axis | 1 | share of the second moment along each principal axis
fit | reference | 1 | residual of ICP onto the reference, both of unit root mean square radius
fit_mirrored | reference | 1 | the same for the mirror image of the shape
chirality | reference | 1 | positive if the shape has the reference's chirality, negative if its
    mirror image has
mean_chirality | shape | 1 | mean chirality relative to the references: positive for most shapes,
    negative for their mirror images
reflected | shape | 1 | whether the shape was mirrored (reflect=)
# the report
status | shape | 1 | ok, repaired, flagged or excluded
reason | shape | 1 | findings and repairs
warning | shape | 1 | findings that were left as they are
flag_kinds | shape | 1 | kinds of findings for which the shape is flagged
warning_kinds | shape | 1 | kinds of other findings
path | shape | 1 | file of the shape
coordinate_system | shape | 1 | coordinate system and unit of that file
area | shape | L2 | area of the surface
self_intersections | shape | 1 | triangles that intersect others, -1 if not counted
file_vertices | shape | 1 | vertices in the file
file_triangles | shape | 1 | triangles in the file
nonfinite_vertices | shape | 1 | vertices that are not finite
welded_vertices | shape | 1 | vertices welded to another
degenerate_triangles | shape | 1 | triangles that repeat a corner
duplicate_triangles | shape | 1 | triangles dropped because others have the same corners
flipped_edges | shape | 1 | long edges of zero-area triangles flipped
flat_triangles | shape | 1 | zero-area triangles dropped
nonmanifold_edges | shape | 1 | edges with more than two triangles
cut_edges | shape | 1 | sides of edges that were cut open
split_vertices | shape | 1 | vertices added where a vertex was not manifold
inserted_vertices | shape | 1 | vertices inserted on edges where two components share both ends
reoriented_triangles | shape | 1 | triangles reoriented
unreferenced_vertices | shape | 1 | vertices without triangles
closed_holes | shape | 1 | holes closed
components | shape | 1 | connected components found
dropped_components | shape | 1 | connected components dropped
area_dropped | shape | 1 | share of the area in the dropped components
holes | shape | 1 | boundary loops
genus | shape | 1 | genus, summed over the components
seconds | stage | s | wall time of the stage
peak_memory | stage | MiB | peak resident memory of this process and its workers in the stage
""")


class Table(dict[str, tuple[tuple[str, ...], str, str]]):
    """Map the name of a variable to its dims, unit and meaning.

    The rows of extensions are added when a name is looked up that the core lacks.  They cannot
    change rows of the core or of each other.
    """

    def __init__(self, rows: Mapping[str, tuple[str, str, str]]):
        super().__init__()
        self.extended = False
        self.add(rows)

    def add(self, rows: Mapping[str, tuple[str, str, str]]) -> None:
        """Add rows, whose dims are one string."""
        for name, (dims, unit, long_name) in rows.items():
            row = (tuple(dims.split()), unit, long_name)
            if self.setdefault(name, row) != row:
                log.warning("%s is in the table already; another row of that name is ignored", name)

    def __contains__(self, name: object) -> bool:
        if not super().__contains__(name) and not self.extended:
            self.extended = True
            for rows in extensions("s4a.variables").values():
                self.add(rows)
        return super().__contains__(name)

    def __missing__(self, name: str) -> tuple[tuple[str, ...], str, str]:
        if name in self:
            return self[name]
        raise KeyError(name)


TABLE = Table(ROWS)

# index variables and the dim that they refer to; -1 refers to nothing
_OF_DIM = {
    "vertex": "corner_vertex edge_vertex vertex_of_file coarse_vertex guide_vertex "
    "sample_cell local_sample algorithm_reverse",
    "file_vertex_index": "file_vertex",
    "original_vertex": "sample_vertex local_vertex registered_match",
    "triangle": "template_triangle",
    "source_vertex": "algorithm_match true_match",
}
POINTS_INTO = {name: dim for dim, names in _OF_DIM.items() for name in names.split()}
NOWHERE = {"vertex_of_file", "sample_vertex", "true_match"}


# required contents of a file of a study: variables, text attributes, numeric attributes
SEEN = "surface compactness chirality open_boundary lattice self_intersections intersecting"
HOLDS = {
    "original": ("position corner_vertex file_vertex", "status reason", "area"),
    "coarse/shape": (
        "position corner_vertex vertex_area sample_vertex coarse_vertex coarse_weight eigenvalue "
        "eigenfunction",
        "laplacian",
        "wrapped kept_whole",
    ),
    "coarse/scalable": (
        "position corner_vertex vertex_area sample_vertex edge_vertex cotan_weight edge_mass "
        "sample_cell local_vertex local_sample local_weight eigenvalue eigenfunction",
        "laplacian",
        "wrapped kept_whole",
    ),
    "network/descriptor": (
        "descriptor_position descriptor_area descriptor_normal descriptor_asymmetry moment",
        "",
        SEEN,
    ),
    "network/comparison": ("moment fit fit_mirrored chirality", "", SEEN),
    "network/chirality": ("shape mean_chirality reflected", "remarks", ""),
    "network/voters": ("shape rotation translation", "", ""),
    "network/alignment": ("rotation translation", "reference ambiguity", "residual n_poses"),
    "network/initial": ("source target fmap_initial", "", ""),
    "network": ("source target fmap_initial fmap weight cycle_error", "", ""),
    "latent": (
        "shape latent_basis latent_eigenvalue area_difference conformal_difference "
        "distance_to_limit",
        "median",
        "",
    ),
    "latent/shape": (
        "latent_basis area_difference conformal_difference distance_to_limit",
        "",
        "",
    ),
    "iterations": ("shape source target fmap latent_basis latent_eigenvalue", "", ""),
    "registration": ("position corner_vertex vertex_area", "template", ""),
    "registration/shape": (
        "registered_match displacement rotation translation scale confidence template_triangle "
        "template_barycentric",
        "initialisation",
        "score",
    ),
    "pca": (
        "shape mean_displacement deformation standard_deviation score explained_variance_ratio",
        "",
        "",
    ),
    "fields": ("shape transferred_field", "", ""),
    "subjects": ("shape", "", ""),
    "report": (
        "shape stage status reason warning path area seconds",
        "template remarks no_modes",
        "",
    ),
}
OMITTED = ("shape", "pair", "iteration")  # leading dims that a file of one of them lacks
TEXTS = set("source target status reason warning path coordinate_system shape stage".split())


def variable(name: str, data: ArrayLike, **attrs: str | float | list[str]) -> xr.Variable:
    """Return a variable of the table with its dims, unit and meaning.

    Parameters
    ----------
    name : str
        A name of :data:`TABLE`.
    data : array_like
        Values.  The number of axes must be that of the table, or one less if the table starts
        with ``shape``.
    **attrs
        Further attributes: str, int, float or lists of str, the types of netCDF.

    Returns
    -------
    xarray.Variable

    Raises
    ------
    ValueError
        If the name is not in the table, or the number of axes differs.

    Examples
    --------
    >>> from s4a.schema import variable
    >>> variable("position", [[0.0, 0.0, 1.0]]).dims
    ('vertex', 'xyz')
    """
    if name not in TABLE:
        raise ValueError(
            f"no variable {name!r} in the schema; add a row to s4a.schema.ROWS, or to the entry "
            "point s4a.variables of an extension"
        )
    dims, unit, long_name = TABLE[name]
    data = np.asarray(data)
    if data.ndim == len(dims) - 1 and dims[0] in OMITTED:
        dims = dims[1:]
    if data.ndim != len(dims):
        raise ValueError(f"{name} needs the dims {dims}, found an array of shape {data.shape}")
    return xr.Variable(dims, data, {"units": unit, "long_name": long_name, **attrs})


def covariate(name: str, data: ArrayLike) -> xr.Variable:
    """Return a column of the user's table as a variable.

    Examples
    --------
    >>> from s4a.schema import covariate
    >>> covariate("age", [31, 42]).attrs["long_name"]
    "column 'age' of the table of the shapes"
    """
    return xr.Variable(
        ("shape",),
        np.asarray(data),
        {"units": "as in the table", "long_name": f"column {name!r} of the table of the shapes"},
    )


def dataset(attrs: Mapping[str, Any] | None = None, **variables: ArrayLike) -> xr.Dataset:
    """Return a Dataset of variables of the table: ``dataset(position=X, corner_vertex=T)``."""
    return xr.Dataset({name: variable(name, data) for name, data in variables.items()}, attrs=attrs)


def unit_of(values: xr.DataArray | xr.Dataset) -> str:
    """Return the unit of length of a variable or mesh, or "unit of the input" if unknown.

    Examples
    --------
    >>> from s4a.schema import dataset, in_unit, unit_of
    >>> unit_of(in_unit(dataset(position=[[0.0, 0.0, 1.0]]), "mm")["position"])
    'mm'
    """
    return str(values.attrs.get("units") or values.attrs.get("unit") or INPUT)


def in_unit(data: xr.Dataset, unit: str | None, *, of: str = INPUT) -> xr.Dataset:
    """Return a Dataset with its unit in place of "unit of the input", or of `of`.

    Examples
    --------
    >>> from s4a.schema import dataset, in_unit
    >>> in_unit(dataset(vertex_area=[1.0]), "mm")["vertex_area"].attrs["units"]
    'mm^2'
    """
    if not unit or unit == of:
        return data
    units = {INPUT: unit, INPUT2: f"{unit}^2"} if of == INPUT else {of: unit}
    data = data.copy()
    for values in data.data_vars.values():
        before = values.attrs.get("units", ONE)
        values.attrs["units"] = units.get(before, before)
    return data


EXPECTED: dict[type, str] = {
    xr.Dataset: "a Dataset, such as a mesh that s4a.read_shape returns",
    xr.DataTree: "a DataTree, such as s4a.analyse or s4a.open_study returns",
    dict: "a dict of names to meshes",
}


def check_type(value: object, kind: Any, what: str = "study", expected: str = "") -> None:
    """Raise TypeError unless an argument is of a type; it says what is `expected`.

    Examples
    --------
    >>> import xarray as xr
    >>> from s4a.schema import check_type
    >>> check_type("brains", xr.DataTree)
    Traceback (most recent call last):
    TypeError: study must be a DataTree, such as s4a.analyse or s4a.open_study returns; found str
    """
    if not isinstance(value, kind):
        expected = expected or EXPECTED[kind]
        raise TypeError(f"{what} must be {expected}; found {type(value).__name__}")


def require(data: xr.Dataset, *names: str, what: str = "dataset") -> None:
    """Raise an error unless `data` is a Dataset with these variables and the dims of the table.

    Examples
    --------
    >>> from s4a.schema import dataset, require
    >>> require(dataset(position=[[0.0, 0.0, 1.0]]), "position")
    """
    check_type(data, xr.Dataset | xr.DataTree, what, EXPECTED[xr.Dataset])
    missing = [name for name in names if name not in data]
    if missing:
        raise ValueError(
            f"the {what} needs the variables {', '.join(names)}; it lacks {', '.join(missing)} "
            f"and has {', '.join(map(str, data.data_vars)) or 'none'}"
        )
    for name in names:
        dims = TABLE[name][0]
        if set(data[name].dims) not in (set(dims), set(dims[1:])):
            raise ValueError(f"{name} of the {what} needs the dims {dims}, found {data[name].dims}")


def check_indices(name: str, values: np.ndarray, sizes: Mapping[str, int]) -> None:
    """Raise ValueError if an index variable of :data:`POINTS_INTO` is out of range.

    Parameters
    ----------
    name : str
    values : ndarray
    sizes : dict of str to int
        Sizes of the dims; a dim that is missing has no upper limit.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.schema import check_indices
    >>> check_indices("corner_vertex", np.array([[0, 1, 2]]), {"vertex": 3})
    """
    if name not in POINTS_INTO or not values.size:
        return
    dim, least = POINTS_INTO[name], -1 if name in NOWHERE else 0
    low, high, size = int(values.min()), int(values.max()), sizes.get(dim)
    if low < least or (size is not None and high >= size):
        end = "" if size is None else size - 1
        raise ValueError(f"{name} needs indices {least}..{end} of {dim}, found {low}..{high}")


def check_rows(
    name: str, values: ArrayLike, *shapes: tuple[int, ...], of: str = "vertices"
) -> Array:
    """Return values as an array; raise ValueError unless it has one of the shapes.

    Examples
    --------
    >>> from s4a.schema import check_rows
    >>> check_rows("label", [1, 2], (3,))
    Traceback (most recent call last):
    ValueError: label needs a value for each of the 3 vertices, shape (3,); found shape (2,)
    """
    values = np.asarray(values)
    if values.shape not in shapes:
        needed = f"the {shapes[0][0]} {of}, shape {' or '.join(map(str, dict.fromkeys(shapes)))}"
        raise ValueError(f"{name} needs a value for each of {needed}; found shape {values.shape}")
    return values


def check_switch(name: str, value: object) -> None:
    """Raise ValueError unless an option is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False; found {value!r}")


def check_choice(name: str, value: object, legal: Collection[object]) -> None:
    """Raise ValueError unless an option is one of the legal choices.

    Examples
    --------
    >>> from s4a.schema import check_choice
    >>> check_choice("init", "landmark", ("dense", "landmarks"))
    Traceback (most recent call last):
    ValueError: init must be one of 'dense', 'landmarks'; found 'landmark'
    """
    if value not in legal:
        choices = ", ".join(map(repr, legal))
        raise ValueError(f"{name} must be one of {choices}; found {value!r}")


def check_count(name: str, value: object, least: int = 0, most: int = LARGEST_COUNT) -> None:
    """Raise ValueError unless an option is an integer from `least` to `most`.

    Examples
    --------
    >>> from s4a.schema import check_count
    >>> check_count("n_pairs", 10**22)
    Traceback (most recent call last):
    ValueError: n_pairs must be an integer of at most 2147483647; found a larger one
    """
    if isinstance(value, int | np.integer) and value > most:
        raise ValueError(f"{name} must be an integer of at most {most}; found a larger one")
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}; found {value!r}")


def check_text(name: str, value: object) -> None:
    """Raise ValueError unless an option is a text or None."""
    if not isinstance(value, str | None):
        raise ValueError(f"{name} must be a text or None; found {value!r}")
