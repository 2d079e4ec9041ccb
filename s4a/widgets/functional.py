"""Functional maps (3.3, 4.1, Fig. 2).

The matrix, its modes on both meshes, and ZoomOut step by step.
"""

import ipywidgets
import numpy as np
import traitlets

from s4a.method.fmap import off_diagonal_mass, orthogonality_error, swapped_blocks, zoomout
from s4a.method.shape import Shape
from s4a.show.draw import SIGNED, signed_colors
from s4a.show.live import color_bar
from s4a.widgets.chart import chart
from s4a.widgets.meshes import camera_group, surface
from s4a.widgets.panel import Panel, beside, paragraph, row
from s4a.widgets.scene import scene

STEP = 5
KINDS = [
    ("consistent ZoomOut, as in the study", "study"),
    ("ZoomOut of this pair alone", "zoomout"),
]


class FunctionalMap(Panel):
    """C of a pair; a cell that is clicked shows the two eigenfunctions that it links.

    Attributes
    ----------
    pair : int
        Row of ``/network``.
    cell : tuple (row, column)
        Mode of the target and mode of the source.
    """

    needs = ("network/fmap", "network/fmap_initial")
    title = "Functional map"
    pair = traitlets.Int(0)
    cell = traitlets.Tuple((1, 1))
    live = (("k", "kind", "block", "choice"), ("row", "choice"), ("column", "choice"))
    every = ("row", "column")
    clicks = (("matrix", "row", "row"), ("matrix", "column", "column"))

    def build(self, pair=0, view="corner", up="z"):
        """Choices, matrix and the two surfaces."""
        network = self.study["network"].dataset
        self.source, self.target = (network[key].values.astype(str) for key in ("source", "target"))
        sizes = network.sizes["mode_source_initial"], network.sizes["mode_source"]
        options = [
            (f"{s} → {t}", i) for i, (s, t) in enumerate(zip(self.source, self.target, strict=True))
        ]
        self.choice = ipywidgets.Dropdown(options=options, description="pair")
        self.kind = ipywidgets.Dropdown(options=KINDS, description="map", layout={"width": "340px"})
        steps = sorted({*range(sizes[0], sizes[1], STEP), sizes[1]})
        self.k = ipywidgets.SelectionSlider(
            options=steps,
            value=sizes[1],
            description="modes k",
            continuous_update=False,
            layout={"width": "340px"},
        )
        self.block = ipywidgets.Checkbox(description="first ten modes only", indent=False)
        wide = {"width": "300px"}
        self.row, self.column = (
            ipywidgets.IntSlider(
                1, min=0, max=sizes[1] - 1, description=text, continuous_update=False, layout=wide
            )
            for text in ("target ψ", "source φ")
        )
        self.matrix, self.numbers = chart(), ipywidgets.HTML()
        group = camera_group()
        self.scenes = [scene(group=group, view=view, up=up, height=250) for _ in range(2)]
        self.cache = {}
        self.on_change(self.choice, lambda value: self.set_trait("pair", value))
        self.on_change(self.k, lambda _: self.draw())
        self.on_change(self.kind, lambda _: self.draw())
        self.on_change(self.block, lambda _: self.draw())
        self.on_change(
            self.matrix,
            lambda mark: self.set_trait("cell", (mark["row"], mark["column"])),
            "picked",
        )
        for slider in (self.row, self.column):
            self.on_change(
                slider, lambda _: self.set_trait("cell", (self.row.value, self.column.value))
            )
        self.on_change(self, self.take, "pair")
        self.on_change(self, self.show_cell, "cell")
        self.pair = pair
        self.take(pair)
        return [
            row(self.choice, self.kind),
            row(self.k, self.block),
            row(self.column, self.row),
            self.numbers,
            beside(ipywidgets.VBox([self.matrix]), ipywidgets.VBox(self.scenes)),
        ]

    def take(self, pair):
        """The two meshes of a pair and its first map."""
        self.choice.value = pair
        self.meshes = [
            self.study["coarse"][str(name)].to_dataset()
            for name in (self.source[pair], self.target[pair])
        ]
        self.cache = {}
        self.draw()
        for view, name in zip(self.scenes, (self.source[pair], self.target[pair]), strict=True):
            view.show(*surface(self.study, str(name)))
        self.show_cell(self.cell)

    def map_of(self, k):
        """C at the size k: cut out of the study's map.

        Or by ZoomOut from the first map of the pair.
        """
        network = self.study["network"].dataset.isel(pair=self.pair)
        if self.kind.value == "study":
            return network["fmap"].values[:k, :k]
        first = network["fmap_initial"].values
        size = max((done for done in self.cache if done <= k), default=len(first))
        C = self.cache.get(size, first)
        M, N = (Shape(None, mesh).low for mesh in self.meshes)
        while size < k:
            size = min(size + STEP, k)
            C, _ = zoomout(M, N, C, size, step=STEP)
            self.cache[size] = C
        return C

    def draw(self):
        """The matrix, its numbers, and frames around runs of modes that are exchanged."""
        k = self.k.value
        self.C = C = self.map_of(k)
        blocks = swapped_blocks(C)
        shown = min(10, k) if self.block.value else k
        self.matrix.matrix(
            C[:shown, :shown],
            title=f"{self.source[self.pair]} → {self.target[self.pair]}, {k} × {k}",
            blocks=[block for block in blocks if block[1] < shown],
            row=self.cell[0],
            column=self.cell[1],
        )
        values = self.meshes[0]["eigenvalue"].values
        told = [f"{a}–{b} (eigenvalues {values[a]:.1f}–{values[b]:.1f})" for a, b in blocks]
        more = f" and {len(told) - 3} more" if len(told) > 3 else ""
        swapped = (
            f" Exchanged among each other, framed: modes {', '.join(told[:3])}{more}."
            if told
            else ""
        )
        self.numbers.value = paragraph(
            f"off the diagonal {off_diagonal_mass(C):.1%} of the squared entries; "
            f"|CᵀC − I| / √k = {orthogonality_error(C):.3f}.{swapped or ' No swapped blocks.'} "
            "Blue is positive, red negative, −1 to 1."
        )

    def show_cell(self, cell):
        """The two eigenfunctions that a cell links, on one colour scale."""
        self.row.value, self.column.value = cell
        self.matrix.spec = self.matrix.spec | {"row": cell[0], "column": cell[1]}
        for view, mesh, mode, role in zip(
            self.scenes, self.meshes, cell[::-1], ("source φ", "target ψ"), strict=True
        ):
            function = mesh["eigenfunction"].values[:, mode]
            limit = float(np.quantile(np.abs(function), 0.99))
            value = mesh["eigenvalue"].values[mode]
            view.title = f"{role}{mode} on {self.name_of(view)}, eigenvalue {value:.2f}"
            view.paint(
                signed_colors(function, limit), color_bar(SIGNED, -limit, limit, "eigenfunction")
            )

    def name_of(self, view):
        """The shape that one of the two views shows."""
        return (self.source if view is self.scenes[0] else self.target)[self.pair]
