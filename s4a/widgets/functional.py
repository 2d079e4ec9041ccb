"""Functional maps (3.3, 4.1, Fig. 2): the matrix, its eigenfunctions on both meshes, ZoomOut."""

import ipywidgets
import numpy as np
import traitlets

from s4a.method.fmap import off_diagonal_mass, orthogonality_error, swapped_blocks, zoomout
from s4a.method.shape import Shape
from s4a.schema import Array
from s4a.show.browser import PARTS
from s4a.show.charts import reach
from s4a.show.surfaces import low_text, surface
from s4a.widgets.panel import WIDE, Panel, checkbox, columns, dropdown, int_slider, row
from s4a.widgets.views import DIRECTION, Chart

STEP = 5
KINDS = [
    ("consistent ZoomOut, as in the study", "study"),
    ("ZoomOut of this pair alone", "zoomout"),
]
WHICH = "Consistent ZoomOut of the whole network, or ZoomOut of this pair alone"
ROW = "row of the matrix: the displayed eigenfunction of the target"
COLUMN = "column of the matrix: the displayed eigenfunction of the source"
SIZE = "number of eigenfunctions in the map: ZoomOut adds them step by step"
MOST = 3  # swapped blocks that are listed


class FunctionalMap(Panel):
    """Functional map C of a pair; a click on an entry shows its two eigenfunctions.

    Attributes
    ----------
    pair : int
        Row of ``/network``.
    cell : tuple (row, column)
        Eigenfunction of the target and eigenfunction of the source.

    See Also
    --------
    s4a.widgets.Network : all maps of the study.

    References
    ----------
    M. Ovsjanikov et al. (2012), Functional maps: a flexible representation of maps between shapes,
    ACM Transactions on Graphics 31(4).
    """

    needs = ("network/fmap", "network/fmap_initial")
    title = "Functional map"
    pair = traitlets.Int(0)
    cell = traitlets.Tuple((1, 1))
    live = (("k", "kind", "block", "choice"), ("row", "choice"), ("column", "choice"))
    every = ("row", "column")
    shares = ("pair",)
    clicks = (("matrix", "row", "row"), ("matrix", "column", "column"))

    def build(self, pair: int = 0) -> list[ipywidgets.Widget]:
        """Return the controls, the matrix and the views of the two surfaces."""
        network = self.study["network"].dataset
        self.source, self.target = (network[key].values.astype(str) for key in ("source", "target"))
        first, last = network.sizes["eigenpair_source_initial"], network.sizes["eigenpair_source"]
        ends = zip(self.source, self.target, strict=True)
        options = [(f"{source} → {target}", i) for i, (source, target) in enumerate(ends)]
        self.choice = dropdown("pair", "source and target of the map", options)
        self.kind = dropdown("map", WHICH, KINDS, layout={"width": "29em"})
        sizes = sorted({*range(first, last, STEP), last})
        slider = {"continuous_update": False, "layout": WIDE, "tooltip": SIZE}
        self.k = ipywidgets.SelectionSlider(
            options=sizes, value=last, description="size k", **slider
        )
        self.block = checkbox("first ten only", "show the first 10 × 10 entries of the matrix")
        narrow = {"layout": {"width": "23em"}}
        self.row = int_slider("target ψ", ROW, 1, 0, last - 1, **narrow)
        self.column = int_slider("source φ", COLUMN, 1, 0, last - 1, **narrow)
        self.matrix, self.numbers = Chart(), ipywidgets.HTML()
        self.scenes = [self.new_scene(300), self.new_scene(300)]
        self.maps = {}  # size -> C, of ZoomOut of this pair alone
        self.bind(self.choice, "pair")
        self.redraw(self.draw, self.k, self.kind, self.block)
        self.on_pick(self.matrix, self.pick)
        self.redraw(lambda: self.pick({}), self.row, self.column)
        self.on_change(self, self.show_pair, "pair")
        self.on_change(self, self.show_cell, "cell")
        self.pair = pair
        self.show_pair(pair)
        return [
            row(self.choice, self.kind, self.k, self.block),
            row(self.column, self.row),
            self.numbers,
            columns(self.matrix, *self.scenes, min_width="20em"),
        ]

    def selection(self) -> dict:
        """Return the pair whose map is shown."""
        return {"pair": self.names()}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show the map of the pair, if it has one."""
        for row_of_pair in np.flatnonzero((self.source == pair[0]) & (self.target == pair[1])):
            self.pair = int(row_of_pair)

    def names(self) -> tuple[str, str]:
        """Return source and target of the pair."""
        return str(self.source[self.pair]), str(self.target[self.pair])

    def pick(self, mark: dict) -> None:
        """Select the clicked entry, or that of the sliders."""
        self.cell = mark.get("row", self.row.value), mark.get("column", self.column.value)

    def show_pair(self, pair: int) -> None:
        """Show the two meshes of a pair and its map."""
        self.meshes = [self.study["coarse"][name].to_dataset() for name in self.names()]
        self.maps = {}
        self.draw()
        shapes = zip(self.scenes, self.names(), self.meshes, strict=True)
        for scene, name, mesh in shapes:
            scene.show(*surface(self.study, name))
            scene.caption = low_text(mesh)
        self.show_cell(self.cell)

    def map_of(self, k: int) -> Array:
        """Return C ``(k, k)``: a block of the study's map, or ZoomOut from the initial map."""
        network = self.study["network"].dataset.isel(pair=self.pair)
        if self.kind.value == "study":
            return network["fmap"].values[:k, :k]
        initial = network["fmap_initial"].values
        size = max((known for known in self.maps if known <= k), default=len(initial))
        C = self.maps.get(size, initial)
        source, target = (Shape(coarse=mesh).low for mesh in self.meshes)
        while size < k:
            size = min(size + STEP, k)
            C, _ = zoomout(source, target, C, size, step=STEP)
            self.maps[size] = C
        return C

    def draw(self) -> None:
        """Draw the matrix, its numbers, and frames around swapped blocks of eigenfunctions."""
        k = self.k.value
        self.C = C = self.map_of(k)
        blocks = swapped_blocks(C)
        size = min(10, k) if self.block.value else k
        self.matrix.matrix(
            C[:size, :size],
            title=f"{' → '.join(self.names())}, {k} × {k}",
            note=DIRECTION,
            blocks=[block for block in blocks if block[1] < size],
            row=self.cell[0],
            column=self.cell[1],
        )
        values = self.meshes[0]["eigenvalue"].values
        runs = [f"{a}–{b} (eigenvalues {values[a]:.1f}–{values[b]:.1f})" for a, b in blocks]
        more = f" and {len(runs) - MOST} more" if len(runs) > MOST else ""
        swapped = "No swapped blocks."
        if runs:
            runs = ", ".join(runs[:MOST])
            swapped = f"Swapped blocks (framed): eigenfunctions {runs}{more}."
        self.numbers.value = PARTS.paragraph(
            f"{off_diagonal_mass(C):.1%} of the sum of squares is off the diagonal; "
            f"|CᵀC − I| / √k = {orthogonality_error(C):.3f}. {swapped}"
        )

    def show_cell(self, cell: tuple[int, int]) -> None:
        """Show the two eigenfunctions of an entry on one colour scale."""
        self.row.value, self.column.value = cell
        self.matrix.spec = self.matrix.spec | {"row": cell[0], "column": cell[1]}
        ends = (("source φ", cell[1]), ("target ψ", cell[0]))
        shapes = zip(self.scenes, self.meshes, self.names(), strict=True)
        functions = [
            mesh["eigenfunction"].values[:, i]
            for mesh, (_, i) in zip(self.meshes, ends, strict=True)
        ]
        limit = max(reach(values, 0.99) for values in functions)
        for (role, i), (scene, mesh, name), values in zip(ends, shapes, functions, strict=True):
            eigenvalue = mesh["eigenvalue"].values[i]
            scene.title = f"{role}{i} on {name}, eigenvalue {eigenvalue:.2f}"
            scene.paint_function(values, "eigenfunction", limit)
