"""Output of the commands of this extension."""

import numpy as np
import xarray as xr

from s4a.cli.tables import table
from s4a.method.pca import mahalanobis


def covariation_lines(result: xr.Dataset) -> str:
    """Return a sentence on the covariation of a field with shape.

    Parameters
    ----------
    result : Dataset
        From :func:`s4a_morphometrics.covariation`.
    """
    share = 100 * result["covariance_share"].values[0]
    return (
        f"{result.attrs['field']} against shape: first pair {share:.0f} % of the squared "
        f"covariance, r-PLS = {result['statistic'].item():.2f}, "
        f"p = {result['p_value'].item():.3g}; "
        f"RV = {result['rv'].item():.2f}, p = {result['rv_p'].item():.3g}"
    )


def growth_lines(result: xr.Dataset, time: str) -> str:
    """Return sentences on the visits and the change of shape per unit of time.

    Parameters
    ----------
    result : Dataset
        From :func:`s4a_morphometrics.growth`.
    time : str
        Name of the time variable.
    """
    attrs = result.attrs
    effect = result["effect" if "effect" in result else "field_effect"]
    size = np.abs(effect.values)
    if effect.ndim == 2:
        size = np.sqrt((size**2).sum(1))
    once = f", {attrs['once']} of them with one visit only" if attrs["once"] else ""
    share = 100 * np.nanmedian(result["intraclass_correlation"])
    return (
        f"{result.sizes['shape']} visits of {attrs['subjects']} subjects{once}; {time} "
        f"from {attrs['lowest']:.4g} to {attrs['highest']:.4g}\n"
        f"change per unit of {time}: {np.nanmedian(size):.3g} {effect.attrs['units']} in the "
        f"median, {np.nanmax(size):.3g} at most; {share:.0f} % of the variance is between subjects"
    )


def asymmetry_table(result: xr.Dataset) -> str:
    """Return a table of the variance components of asymmetry, and lines on its size.

    Parameters
    ----------
    result : Dataset
        From :func:`s4a_morphometrics.asymmetry`.
    """
    heads = ["sum_of_squares", "degrees_of_freedom", "mean_square", "variance_share", "f_ratio"]
    rows = [
        [term.item(), *(f"{result[head].sel(term=term).item():.4g}" for head in heads)]
        for term in result["term"]
    ]
    size = result["asymmetry_size"]
    title = f"{result.attrs['symmetry']} symmetry, {size.size} individuals"
    if "sides" in result.attrs:
        title += f", {result.attrs['sides']}"
    lines = [title, table(rows, ["", *(head.replace("_", " ") for head in heads)])]
    lines.append(
        f"asymmetry of an individual {size.mean().item():.3g} {size.attrs['units']} on average, "
        f"{result['fluctuating_size'].mean().item():.3g} without the directional part"
    )
    p = result["antisymmetry_p"].item()
    lines.append(
        f"antisymmetry: kurtosis {result['kurtosis'].item():.2f} along the first component, "
        f"p = {p:.3g} for a kurtosis this low of normal individuals"
    )
    if "involution_error" in result.attrs:
        lines.append(
            f"distance of a vertex and the partner of its partner: "
            f"{100 * result.attrs['involution_error']:.2f} % of sqrt(area)"
        )
    return "\n".join(lines)


def completed_lines(result: xr.Dataset) -> list[str]:
    """Return lines on the result of :func:`s4a_morphometrics.complete`."""
    unit, attrs = result["position"].attrs["units"], result.attrs
    deviation, there = np.linalg.norm(result["completion_sd"], axis=1), result["present"].values
    missing = "" if there.all() else f", of a missing vertex {deviation[~there].mean():.3g}"
    scores = " ".join(f"{score:+.2f}" for score in result["score"].values[:5])
    return [
        f"{100 * attrs['missing']:.1f} % of the template {attrs['template']} are missing",
        f"distance between the modes and the partial shape: {attrs['residual']:.3g} {unit}",
        f"standard deviation of a vertex {deviation[there].mean():.3g} {unit}{missing}",
        f"Mahalanobis {mahalanobis(result['score'].values):.1f}, scores {scores}",
    ]
