"""What the commands of this extension print."""

import numpy as np
import xarray as xr

from s4a.cli.tables import table
from s4a.method.pca import mahalanobis


def covariation_lines(found: xr.Dataset) -> str:
    """How a field varies together with shape, in words.

    Parameters
    ----------
    found : Dataset
        See :func:`s4a_morphometrics.two_block.covariation`.
    """
    share = 100 * found["covariance_share"].values[0]
    return (
        f"{found.attrs['field']} against shape: first pair {share:.0f} % of the squared "
        f"covariance, r-PLS = {found['statistic'].item():.2f}, p = {found['p_value'].item():.3g}; "
        f"RV = {found['rv'].item():.2f}, p = {found['rv_p'].item():.3g}"
    )


def growth_lines(found: xr.Dataset, time: str) -> str:
    """What was seen, and how far shape changes in a unit of time, in words.

    Parameters
    ----------
    found : Dataset
        See :func:`s4a_morphometrics.longitudinal.growth`.
    time : str
        Name of the time.
    """
    attrs = found.attrs
    effect = found["effect" if "effect" in found else "field_effect"]
    size = np.abs(effect.values)
    if effect.ndim == 2:
        size = np.sqrt((size**2).sum(1))
    once = f", {attrs['once']} of them seen at one time only" if attrs["once"] else ""
    share = 100 * np.nanmedian(found["intraclass_correlation"])
    return (
        f"{found.sizes['shape']} visits of {attrs['subjects']} subjects{once}; {time} "
        f"{attrs['lowest']:.4g} to {attrs['highest']:.4g}\n"
        f"change per unit of {time}: {np.nanmedian(size):.3g} {effect.attrs['units']} in the "
        f"middle, {np.nanmax(size):.3g} at most; {share:.0f} % of the variance is between subjects"
    )


def asymmetry_table(found: xr.Dataset) -> str:
    """Shares of variance of left against right, how large each part is, and antisymmetry.

    Parameters
    ----------
    found : Dataset
        See :func:`s4a_morphometrics.bilateral.asymmetry`.
    """
    heads = ["sum_of_squares", "degrees_of_freedom", "mean_square", "variance_share", "f_ratio"]
    rows = [
        [term.item(), *(f"{found[head].sel(term=term).item():.4g}" for head in heads)]
        for term in found["term"]
    ]
    size = found["asymmetry_size"]
    of = f"{found.attrs['symmetry']} symmetry, {size.size} individuals"
    if "sides" in found.attrs:
        of += f", {found.attrs['sides']}"
    lines = [of, table(rows, ["", *(head.replace("_", " ") for head in heads)])]
    lines.append(
        f"asymmetry of an individual {size.mean().item():.3g} {size.attrs['units']} on average, "
        f"{found['fluctuating_size'].mean().item():.3g} without the directional part"
    )
    p = found["antisymmetry_p"].item()
    lines.append(
        f"antisymmetry: kurtosis {found['kurtosis'].item():.2f} along the first component, "
        f"p = {p:.3g} that normal individuals have as low a one"
    )
    if "gap" in found.attrs:
        lines.append(
            f"the partner of a vertex's partner misses it by {100 * found.attrs['gap']:.2f} % of "
            "sqrt(area)"
        )
    return "\n".join(lines)


def completed_lines(found: xr.Dataset) -> list[str]:
    """What :func:`s4a_morphometrics.complete` says of a part, in words."""
    unit, said = found["position"].attrs["units"], found.attrs
    deviation, there = np.linalg.norm(found["completion_sd"], axis=1), found["present"].values
    missing = "" if there.all() else f", of a missing one {deviation[~there].mean():.3g}"
    scores = " ".join(f"{score:+.2f}" for score in found["score"].values[:5])
    return [
        f"{100 * said['missing']:.1f} % of the template {said['template']} are missing",
        f"left by the modes on the part: {said['residual']:.3g} {unit}",
        f"standard deviation of a vertex {deviation[there].mean():.3g} {unit}{missing}",
        f"Mahalanobis {mahalanobis(found['score'].values):.1f}, scores {scores}",
    ]
