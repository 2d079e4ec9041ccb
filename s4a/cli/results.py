"""What the commands of fields and growth print, see :mod:`s4a.cli.tables`."""

import numpy as np
import xarray as xr


def covariation_lines(found: xr.Dataset) -> str:
    """How a field varies together with shape, in words.

    Parameters
    ----------
    found : Dataset
        See :func:`s4a.analysis.covariation.covariation`.
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
        See :func:`s4a.analysis.growth.growth`.
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
