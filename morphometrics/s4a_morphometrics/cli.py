"""The commands that this extension adds: asymmetry, growth, covariation, complete and export."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import s4a
from s4a.cli import command
from s4a.cli.commands import SYSTEM, study_to_test, write

if TYPE_CHECKING:
    import xarray as xr


def drawn(permutations: int | None, seed: int) -> dict[str, Any]:
    """How often a test rearranges, and the seed."""
    return {"seed": seed} | ({} if permutations is None else {"n_permutations": permutations})


def tell(study: "xr.DataTree", found: "xr.Dataset", what: str, lines: str, out: str) -> None:
    """Write a result as netCDF and CSV, and say what it found."""
    from s4a.cli import tables

    s4a.analysis.export.write_results(found, out, what)
    write(lines)
    tested = {"growth": "change within subjects", "asymmetry": "directional asymmetry"}
    if what in tested:
        write("\n" + tables.significance(found, found, tested[what], study))


def asymmetry(
    study: str,
    *,
    subject: str | None = None,
    side: str | None = None,
    of: Literal["vector", "normal"] = "normal",
    table: str | None = None,
    include_flagged: bool = False,
    permutations: int | None = None,
    out: str | None = None,
    seed: int,
) -> int:
    """Analyse asymmetry: shares of variance, directional asymmetry, antisymmetry.

    Every shape against its mirror image, or both sides of every subject.

    Parameters
    ----------
    study : STUDY
        its folder
    subject : COLUMN
        subject of each left and right shape (default: every shape and its mirror image)
    side : COLUMN
        side of each shape
    of
        what is tested at every vertex: along the normals, or vectors
    table : PATH
        CSV with a column 'shape', in place of the table of the study
    include_flagged
        include flagged shapes
    permutations : N
        changes of sign (default: 999)
    out : FOLDER
        for netCDF, CSV, the page (default: STUDY/statistics)
    """
    import s4a_morphometrics as m
    from s4a_morphometrics import words

    tree, folder = study_to_test(study, out, table, include_flagged)
    found = m.asymmetry(tree, subject=subject, side=side, of=of, **drawn(permutations, seed))
    tell(tree, found, "asymmetry", words.asymmetry_table(found), folder)
    if found.attrs["symmetry"] == "object":
        mesh = s4a.geometry.mesh.as_arrays(m.symmetric_template(tree, found))
        s4a.write_mesh(Path(folder) / "symmetric.ply", *mesh)
    page = Path(folder) / "asymmetry.html"
    s4a.write_page(m.asymmetry_modes(tree, found), page, title="Left against right")
    write(f"\nresults: {folder}; the modes of asymmetry: {page}")
    return 0


def growth(
    study: str,
    *,
    time: str,
    subject: str,
    covariates: list[str] | None = None,
    field: str | None = None,
    of: Literal["vector", "normal"] = "vector",
    variances: Literal["equal", "unequal"] = "equal",
    table: str | None = None,
    include_flagged: bool = False,
    permutations: int | None = None,
    out: str | None = None,
    seed: int,
) -> int:
    """Test and animate the change of shape with time in repeated observations of subjects.

    Parameters
    ----------
    study : STUDY
        its folder
    time : COLUMN
        age, or time since the first visit
    subject : COLUMN
        subject of each shape
    covariates : COLUMN
        covariates, separated by spaces or commas
    field : NAME
        name of a field of s4a fields, in place of shape
    of
        what is tested at every vertex: vectors, or along the normals
    variances
        unequal if the subjects differ in variance; signs of subjects are then permuted
    table : PATH
        CSV with a column 'shape', in place of the table of the study
    include_flagged
        include flagged shapes
    permutations : N
        of visits within subjects (default: 999)
    out : FOLDER
        for netCDF, CSV, the page (default: STUDY/statistics)
    """
    import s4a_morphometrics as m
    from s4a_morphometrics import words

    tree, folder = study_to_test(study, out, table, include_flagged)
    tested: dict[str, Any] = {
        "covariates": covariates,
        "field": field,
        "of": of,
        "variances": variances,
    }
    found = m.growth(tree, time, subject, **tested, **drawn(permutations, seed))
    tell(tree, found, "growth", words.growth_lines(found, time), folder)
    if not field:
        moving = s4a.statistics.regression_modes(tree, found, time)
        s4a.write_page(moving, Path(folder) / "growth.html", title=f"Growth with {time}")
        s4a.write_film(moving, Path(folder) / "growth.gif")
    write(f"\nresults: {folder}")
    return 0


def covariation(
    study: str,
    field: str,
    *,
    covariates: list[str] | None = None,
    table: str | None = None,
    include_flagged: bool = False,
    permutations: int | None = None,
    out: str | None = None,
    seed: int,
) -> int:
    """Analyse the covariation of a field with shape by partial least squares.

    Parameters
    ----------
    study : STUDY
        its folder
    field : FIELD
        name of a field of s4a fields
    covariates : COLUMN
        covariates, separated by spaces or commas
    table : PATH
        CSV with a column 'shape', in place of the table of the study
    include_flagged
        include flagged shapes
    permutations : N
        of the shapes (default: 999)
    out : FOLDER
        for netCDF, CSV, the page (default: STUDY/statistics)
    """
    import s4a_morphometrics as m
    from s4a_morphometrics import words

    tree, folder = study_to_test(study, out, table, include_flagged)
    found = m.covariation(tree, field, covariates=covariates, **drawn(permutations, seed))
    tell(tree, found, "covariation", words.covariation_lines(found), folder)
    page = Path(folder) / "covariation.html"
    s4a.write_page(m.covariation_modes(tree, found), page, title=f"Shape with {field}")
    write(f"\nresults: {folder}")
    return 0


def complete(
    study: str,
    part: str,
    *,
    out: str,
    landmarks: str | None = None,
    samples: int = 10,
    components: int | str | None = None,
    seed: int,
    **system: Any,
) -> int:
    """Match a part of a shape to a finished study, and estimate the whole shape.

    Parameters
    ----------
    study : STUDY
        its folder
    part : PART
        mesh file of a part of a shape
    out : FOLDER
        for completed.nc and PLY
    landmarks : PATH
        landmarks of the part, three or more with names of the template's, which guide registration
    samples : N
        shapes to draw from those that agree with the part
    components : COMPONENTS
        'largest', 'all' or how many pieces of the part to keep (default: as in the study)
    """
    import s4a_morphometrics as m
    from s4a_morphometrics import words

    options: dict[str, Any] = {
        "landmarks": landmarks,
        "components": components,
        "n_samples": samples,
    }
    found = m.complete(s4a.open_study(study), part, seed=seed, **options, **system)
    paths = m.write_completed(found, out)
    write("\n".join(words.completed_lines(found)))
    write(f"\nwritten: {', '.join(map(str, paths[:2]))}, samples: {len(paths) - 2}")
    return 0


def export(
    study: str,
    *,
    to: Literal["slicer", "shapeworks", "scalismo", "paraview", "r", "nifti"],
    out: str,
    points: int | None = None,
    modes: int | None = None,
    template_landmarks: str | None = None,
    labels: str | None = None,
    grid: str | None = None,
    **system: Any,
) -> int:
    """Write a study for Slicer, ShapeWorks, Scalismo, ParaView, R, or as label volumes.

    Parameters
    ----------
    study : STUDY
        its folder
    to
        target program
    out : FOLDER
        for its files
    points : N
        slicer, shapeworks, r: farthest-point samples (default: 500)
    modes : N
        scalismo, paraview: the first modes (default: all; paraview: 3)
    template_landmarks : FILE
        slicer: landmarks of the template, transferred to all shapes (default: its own)
    labels : FILE
        nifti: labels of the template's vertices, whole numbers (default: its own)
    grid : FILE
        nifti: volume whose voxels are labelled (default: the volume of each shape)
    """
    from s4a_morphometrics import write_for
    from s4a_morphometrics.statistics_commands import template_labels

    tree = s4a.open_study(study)
    read = s4a.input.annotations.read_landmarks
    marks = read(template_landmarks) if template_landmarks else None
    label = template_labels(tree, labels)
    asked = {"n_points": points, "n_modes": modes, "landmarks": marks, "label": label, "grid": grid}
    options = {name: value for name, value in {**asked, **system}.items() if value is not None}
    paths = write_for(tree, out, to, **options)
    write(f"{len(paths)} files for {to} in {out}, such as {paths[-1].name}")
    return 0


ASYMMETRY = command(asymmetry, ("seed",))
GROWTH = command(growth, ("seed",))
COVARIATION = command(covariation, ("seed",))
COMPLETE = command(complete, ("seed", *SYSTEM))
EXPORT = command(export, SYSTEM)
