"""Panel of bilateral asymmetry for notebooks."""

from typing import Any

import ipywidgets
import numpy as np
import xarray as xr

from s4a.schema import unit_of
from s4a.widgets.maps import POSITIVE_MAPS, SIGNED_MAPS, Maps
from s4a.widgets.panel import WIDE, dropdown, row

INDIVIDUAL = "individual"
TOOLTIP = "the individual whose asymmetry along the normals is shown"


class Asymmetry(Maps):
    """Show directional and fluctuating asymmetry at each vertex, and that of each individual.

    Vertices without significant directional asymmetry are grey; a click shows the values.

    Parameters
    ----------
    study : xarray.DataTree
        The tested study.
    result : xarray.Dataset, optional
        From :func:`s4a_morphometrics.asymmetry`; by default ``/asymmetry`` of the study, which also
        gives ``s4a.explore`` a tab.
    view, up
        Initial view of the surface; see :func:`s4a.show.draw.rotation`.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> from s4a_morphometrics import asymmetry
    >>> study = s4a.synthetic.example_study()
    >>> panel = s4a.widgets.Asymmetry(study, asymmetry(study, n_permutations=19))
    >>> panel.map.label, panel.where.label
    ('directional asymmetry', 'family-wise')
    >>> panel.close()
    """

    title = "Asymmetry"
    needs = ("registration/position", "asymmetry/directional")
    signed = {"directional_normal": "directional asymmetry"} | SIGNED_MAPS
    positive = {"fluctuating": "fluctuating asymmetry"} | POSITIVE_MAPS
    live = (("map", "where", "level"), ("individual",))

    def __init__(self, study: xr.DataTree, found: xr.Dataset | None = None, **options: Any):
        if found is not None:
            study = study.assign({"asymmetry": xr.DataTree(found)})
        found = study["asymmetry"].to_dataset() if "asymmetry" in study.children else xr.Dataset()
        super().__init__(study, found, **options)

    def build(self, **options: Any) -> list[ipywidgets.Widget]:
        """Return the controls and the surface."""
        self.known = [*self.known, ("of one individual", INDIVIDUAL)]
        names = self.result["individual"].values.tolist()
        self.individual = dropdown("individual", TOOLTIP, names, layout=WIDE)
        _, *below = super().build(**options)
        self.redraw(self.paint, self.individual)
        return [row(self.map, self.individual), *below]

    def surface(self) -> xr.DataArray:
        """Return the symmetric consensus."""
        return self.result["symmetric_position"]

    def values(self) -> tuple[np.ndarray, bool, str]:
        """Return the map ``(n,)``, whether it is signed, and its unit."""
        if self.map.value != INDIVIDUAL:
            return super().values()
        asymmetry = self.result["asymmetry"].sel(individual=self.individual.value)
        return (asymmetry.values * self.normals).sum(1), True, unit_of(asymmetry)

    def paint(self) -> None:
        """Colour the surface by the map, and name the individual in its title."""
        super().paint()
        if self.map.value == INDIVIDUAL:
            self.scene.title = f"asymmetry of {self.individual.value}"

    def summary(self, shown: np.ndarray) -> str:
        """Return the significant share of the area, and p of the shape and of antisymmetry."""
        p = self.result["antisymmetry_p"].item()
        return f"{super().summary(shown)}; antisymmetry p = {p:.3g}"
