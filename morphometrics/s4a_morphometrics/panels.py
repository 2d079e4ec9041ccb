"""The panel of left against right, for notebooks."""

from typing import Any

import ipywidgets
import numpy as np
import xarray as xr

from s4a.schema import unit_of
from s4a.widgets.maps import POSITIVE_MAPS, SIGNED_MAPS, Maps
from s4a.widgets.panel import WIDE, dropdown, row

INDIVIDUAL = "individual"
OF = "whose asymmetry is shown, along the normals"


class Asymmetry(Maps):
    """Directional and fluctuating asymmetry at every vertex, and that of each individual.

    Grey where the directional one is not significant; a click tells the values there.

    Parameters
    ----------
    study : xarray.DataTree
        That was tested.
    found : xarray.Dataset, optional
        Of :func:`s4a_morphometrics.asymmetry`; by default ``/asymmetry`` of the study, with which
        ``s4a.explore`` has a tab of it.
    view, up
        From where the surface is seen first; see :func:`s4a.show.draw.rotation`.

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
        """Choices, of an individual too, and the surface."""
        self.known = [*self.known, ("of one individual", INDIVIDUAL)]
        names = self.result["individual"].values.tolist()
        self.individual = dropdown("individual", OF, names, layout=WIDE)
        _, *below = super().build(**options)
        self.redraw(self.paint, self.individual)
        return [row(self.map, self.individual), *below]

    def surface(self) -> xr.DataArray:
        """The symmetric consensus, of which asymmetries are differences."""
        return self.result["symmetric_position"]

    def values(self) -> tuple[np.ndarray, bool, str]:
        """The map ``(n,)``, whether it has signs, and its unit."""
        if self.map.value != INDIVIDUAL:
            return super().values()
        own = self.result["asymmetry"].sel(individual=self.individual.value)
        return (own.values * self.normals).sum(1), True, unit_of(own)

    def paint(self) -> None:
        """The map in colours, named after the individual where it is of one."""
        super().paint()
        if self.map.value == INDIVIDUAL:
            self.scene.title = f"asymmetry of {self.individual.value}"

    def summary(self, shown: np.ndarray) -> str:
        """How much of the area is significant, p of the whole shape and of antisymmetry."""
        p = self.result["antisymmetry_p"].item()
        return f"{super().summary(shown)}; antisymmetry p = {p:.3g}"
