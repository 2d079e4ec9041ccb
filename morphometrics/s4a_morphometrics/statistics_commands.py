"""Commands of fields, regions, nuisances and of generalization with new correspondences."""

from typing import TYPE_CHECKING, Any, Literal

import s4a
from s4a.cli import command, tables
from s4a.cli.commands import labels_in, study_to_test, write, write_statistics

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr


def fields(
    study: str, folder: str, *, name: str, unit: str | None = None, partial: bool = False
) -> int:
    """Transfer a scalar field of every shape, such as thickness, to the template.

    Parameters
    ----------
    study : STUDY
        folder of the study
    folder : FOLDER
        one file per shape: NPY, NPZ, PLY, CSV, GIFTI or FreeSurfer's curv
    name : NAME
        name of the field, and of its array, column or property in the files
    unit : UNIT
        unit of its numbers, such as mm
    partial
        allow shapes without the field; tests leave these shapes out
    """
    import numpy as np

    import s4a_morphometrics as m

    tree = m.with_field(s4a.open_study(study), name, folder, unit=unit, partial=partial)
    path = m.write_field(tree, name, study)
    field = tree["fields"][name].to_dataset()["transferred_field"]
    valid = np.isfinite(field.values)
    write(
        f"{name} of {valid.any(1).sum()} of {len(valid)} shapes, "
        f"{np.nanmin(field):.4g} to {np.nanmax(field):.4g} {field.attrs['units']}, mean "
        f"{np.nanmean(field):.4g}, at {100 * valid.mean():.0f} % of the template's vertices: "
        f"{path}",
        f"s4a field-statistics {study} {name} --group COLUMN tests it",
    )
    return 0


def field_statistics(
    study: str,
    field: str,
    *,
    group: str | None = None,
    regress_on: str | None = None,
    covariates: list[str] | None = None,
    table: str | None = None,
    variances: Literal["equal", "unequal"] = "equal",
    include_flagged: bool = False,
    permutations: int | None = None,
    out: str | None = None,
    seed: int,
) -> int:
    """Test groups and variables of the table on a field instead of shape.

    Parameters
    ----------
    study : STUDY
        folder of the study
    field : FIELD
        name of a field of s4a fields
    group : COLUMN
        test and map of the difference between groups; classification
    regress_on : COLUMN
        regression of the field on a number, such as age
    covariates : COLUMN
        covariates of both, separated by spaces or commas
    table : PATH
        CSV with a column 'shape', instead of the table of the study
    variances
        residual variances of the fields; unequal if groups have different covariance
    include_flagged
        include flagged shapes
    permutations : N
        permutations per test (default: 9999; 999 at every vertex; 99 for classification)
    out : FOLDER
        for netCDF and CSV (default: STUDY/statistics)
    """
    import s4a_morphometrics as m

    if not (group or regress_on):
        raise ValueError("no test chosen: give --group COLUMN or --regress-on COLUMN")
    tree, out = study_to_test(study, out, table, include_flagged)
    n = {} if permutations is None else {"n_permutations": permutations}
    options: dict[str, Any] = {"covariates": covariates, "variances": variances, "seed": seed} | n
    results = {}
    if group:
        results["group"] = m.field_group_test(tree, field, group, **options)
        results["group_map"] = m.field_group_map(tree, field, group, **options)
        few = {"n_permutations": min(permutations or 99, 99), "seed": seed}  # training is slow
        results["classification"] = m.field_classify(tree, field, group, **few)
        title = f"{field} in groups of {group}"
        write(tables.significance(results["group"], results["group_map"], title, tree))
        write(tables.classification_line(results["classification"]), "")
    if regress_on:
        results["regression"] = fit = m.field_regression(tree, field, regress_on, **options)
        write(tables.significance(fit, fit, f"{field} on {regress_on}", tree), "")
    for name, result in results.items():
        s4a.analysis.export.write_results(result, out, f"{field}_{name}")
    write(f"results: {out}")
    return 0


def region_statistics(
    study: str,
    *,
    region: list[int | str] | None = None,
    labels: str | None = None,
    min_confidence: float = 0.0,
    regress_out: list[str] | None = None,
    restore_size: bool = False,
    group: str | None = None,
    regress_on: str | None = None,
    covariates: list[str] | None = None,
    table: str | None = None,
    variances: Literal["equal", "unequal"] = "equal",
    include_flagged: bool = False,
    permutations: int | None = None,
    out: str | None = None,
    seed: int,
) -> int:
    """Evaluate and test a region of the template, adjusted for covariates or with size restored.

    Parameters
    ----------
    study : STUDY
        folder of the study
    region : LABEL
        only vertices of the template with these labels
    labels : FILE
        labels of the template's vertices (default: its own): NPY, NPZ (FILE:NAME), CSV, GIFTI or
        annot
    min_confidence : SHARE
        only vertices whose mean confidence is this large, 0 to 1
    regress_out : COLUMN
        covariates whose effect (by regression) is removed from all shapes
    restore_size
        restore the size that --remove-size removed
    group : COLUMN
        test and map of the difference between groups; classification
    regress_on : COLUMN
        regression of shape on a number, such as age; its animation
    covariates : COLUMN
        covariates of both, separated by spaces or commas
    table : PATH
        CSV with a column 'shape', instead of the table of the study
    variances
        residual variances of the shapes; unequal if groups have different covariance
    include_flagged
        include flagged shapes
    permutations : N
        permutations per test (default: 9999; 999 at every vertex; 99 for classification)
    out : FOLDER
        for netCDF and CSV (default: STUDY/statistics)
    """
    if covariates and not (group or regress_on):
        raise ValueError("--covariates needs a test: give --group or --regress-on")
    if labels and not region:
        raise ValueError("--labels needs --region LABEL...: give both, or leave it out")
    tree, out = study_to_test(study, out, table, include_flagged)
    tree = restricted(tree, restore_size, regress_out, region, labels, min_confidence)
    options = {"covariates": covariates, "seed": seed, "variances": variances}
    write_statistics(tree, out, group, regress_on, permutations, options)
    return 0


def restricted(
    study: "xr.DataTree",
    restore_size: bool,
    regress_out: list[str] | None,
    region: list[int | str] | None,
    labels: str | None,
    min_confidence: float,
) -> "xr.DataTree":
    """Return the study restricted to a region, adjusted for covariates, or with size."""
    import s4a_morphometrics as m

    changes = []
    if restore_size:
        study = m.with_size(study)
        changes.append("with size restored")
    if regress_out:
        study = m.without(study, regress_out)
        changes.append(f"without {', '.join(regress_out)}")
    if region or min_confidence:
        whole = study["registration"].sizes["vertex"]
        label = template_labels(study, labels)
        study = m.within(study, region, labels=label, min_confidence=min_confidence)
        changes.append(f"{study['registration'].sizes['vertex']} of {whole} vertices")
    if changes:
        write("; ".join(changes) + "\n")
    return study


def template_labels(study: "xr.DataTree", file: str | None) -> "np.ndarray | None":
    """Read the labels of the template from a file with one for each vertex of its mesh file."""
    if file is None:
        return None
    template = s4a.analysis.inputs.all_registered(study).attrs["template"]
    return labels_in(file, study["original"][template].to_dataset())


def generalization(
    study: str,
    *,
    include_flagged: bool = False,
    out: str | None = None,
    n_jobs: int,
    seed: int,
) -> int:
    """Compute the generalization of the modes with new correspondences (slow).

    Parameters
    ----------
    study : STUDY
        folder of the study
    include_flagged
        include flagged shapes
    out : FOLDER
        for netCDF and CSV (default: STUDY/statistics)
    """
    import s4a_morphometrics as m

    tree, out = study_to_test(study, out, None, include_flagged)
    result = m.generalization(tree, n_jobs=n_jobs, seed=seed)
    s4a.analysis.export.write_results(result, out, "generalization")
    names = ("generalization", "generalization_surface")
    rows = [
        [c + 1, *(tables.measure_cell(result, name, c) for name in names)]
        for c in range(min(10, result.sizes["component"]))
    ]
    heads = ["components", "between vertices", "to the surface"]
    write(f"lengths in {result['generalization'].attrs['units']}, ± standard error")
    write(tables.table(rows, heads), f"\nresults: {out}")
    return 0


FIELDS = command(fields)
FIELD_STATISTICS = command(field_statistics, ("seed",))
REGION_STATISTICS = command(region_statistics, ("seed",))
GENERALIZATION = command(generalization, ("n_jobs", "seed"))
