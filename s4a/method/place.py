"""A new shape beside a network (4.2, eq. 3): its latent basis from maps to a few shapes of it.

The network stays as it is.  So are placed the shapes that come into a finished study, and those
that are doubtful and must not change what is found for the others.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from s4a.geometry.align import Motion, realign
from s4a.method.first_map import first_map
from s4a.method.latent import latent_basis_of_new
from s4a.method.median import area_differences, conformal_differences, distance_to_identity
from s4a.method.network import spectral_distance
from s4a.method.shape import Basis
from s4a.options import N_SPREAD
from s4a.schema import dataset

NEIGHBOURS = 6  # shapes of the network whose maps a new one has


def nearest_spectra(own: np.ndarray, others: Sequence[np.ndarray], k: int) -> list[int]:
    """The first of the others, and five whose first k eigenvalues are most like its `own`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.place import nearest_spectra
    >>> spectra = [np.array([0.0, i, 2 * i]) for i in (9, 1, 5, 2, 8, 3, 7, 4)]
    >>> nearest_spectra(np.array([0.0, 1, 2]), spectra, 3)
    [0, 1, 3, 5, 7, 2]
    """
    distance = spectral_distance([values[:k] for values in (own, *others)])[0]
    order = np.argsort(distance[2:], kind="stable")  # without itself and the first
    return [0, *(1 + order[: NEIGHBOURS - 1]).tolist()]


def place(
    new: Basis,
    others: list[Basis],
    Y: np.ndarray,
    starts: list[Motion],
    *,
    k_init: int = 20,
    step: int = 5,
    n_spread: int = N_SPREAD,
    **options: Any,
) -> np.ndarray:
    """Latent basis of a new shape from its maps to others, whose bases stay.

    Parameters
    ----------
    new : Basis
    others : list of Basis
        Of :func:`nearest_spectra`.
    Y : float ndarray (p, k, m)
        Their latent bases.
    starts : list of tuple (R, t)
        About the rigid motions of the new shape onto each of them.
    k_init, step, n_spread : see :func:`s4a.analyse`
    **options
        Of :func:`s4a.method.first_map.first_map`.

    Returns
    -------
    float ndarray (k, m)
    """
    maps = []
    for other, start in zip(others, starts, strict=True):
        R, t = realign(new.cloud, other.cloud, start)
        back = R.T, -R.T @ t
        maps.append(first_map(other, new, back, k_init=k_init, n_spread=n_spread, **options).C)
    return latent_basis_of_new(new, others, Y, maps, step=step, n_spread=n_spread)


def latent_of_new(
    Y: np.ndarray, eigenvalues: np.ndarray, latent_eigenvalue: np.ndarray, norm: str
) -> xr.Dataset:
    """``/latent`` of new shapes: bases, shape differences, distances to the limit shape (eq. 5).

    Parameters
    ----------
    Y : float ndarray (n, k, m)
    eigenvalues : float ndarray (n, >= k)
        Of the shapes, for unit area.
    latent_eigenvalue : float ndarray (m,)
        Of the network.
    norm : see :func:`s4a.analyse`
    """
    D = area_differences(Y)
    # one by one, so that the last digit does not depend on the others
    distance = [distance_to_identity(one[None], latent_eigenvalue, norm)[0] for one in D]
    return dataset(
        latent_basis=Y,
        latent_eigenvalue=latent_eigenvalue,
        area_difference=D,
        conformal_difference=conformal_differences(Y, eigenvalues, latent_eigenvalue),
        distance_to_median=np.array(distance),
    )
