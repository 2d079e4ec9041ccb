"""What the commands of fields and of growth print, see :mod:`s4a.cli.tables`."""

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
