"""The network of functional maps (3.4): shapes as nodes, maps as edges, and cycle errors."""

import ipywidgets
import numpy as np
import traitlets
from matplotlib.colors import to_hex

from s4a.method.fmap import match_from_fmap
from s4a.method.network import choose_pairs, connectivity, nearest_by_maps, spectral_distance
from s4a.schema import Array
from s4a.show import charts
from s4a.show.browser import PARTS, color_scale
from s4a.show.draw import CYCLE_ERROR, cycle_error_colors, position_colors
from s4a.show.surfaces import (
    attribute,
    flagged_names,
    labelled,
    network_limits,
    network_positions,
    surface,
)
from s4a.study.tree import excluded_of
from s4a.widgets.panel import Panel, columns, dropdown, int_slider, row
from s4a.widgets.views import DIRECTION, Chart

STAGES = [
    ("before Consistent ZoomOut", "cycle_error_initial"),
    ("after Consistent ZoomOut", "cycle_error"),
]
WHICH = (
    "colour of an edge: its cycle error, the distance of compositions along cycles from the "
    "identity; before or after Consistent ZoomOut"
)
BUDGET = "number of pairs with maps: those of most similar spectra, and a spanning tree"
POSITIONS = (
    "positions of the nodes: on a circle, or first two principal components of the shape "
    "differences"
)
SHOW = "a shape, or a map between two shapes"
NARROW = {"width": "20em"}
MOST = 100  # nodes of a graph
UNKNOWN = "unknown: in no cycle"
ERRORS = "cycle error (logarithmic)"


class Network(Panel):
    """Shapes as nodes, maps as edges coloured by cycle error; a click shows the meshes and the map.

    For more than a hundred shapes, the graph shows the selected shape, the median, and the shapes
    with the shortest paths from them.  The numbers next to the graph refer to all shapes.

    Attributes
    ----------
    edge : int
        Row of ``/network`` that is shown, -1 for none.
    node : str
        The shape that is shown alone, "" for none.

    See Also
    --------
    s4a.widgets.FunctionalMap : the matrix of a map and its eigenfunctions.

    References
    ----------
    R. Huang et al. (2019), Limit shapes: a tool for understanding shape differences and variability
    in 3D model collections, Computer Graphics Forum 38(5).
    """

    needs = tuple(
        f"network/{key}" for key in ("source", "target", "fmap", "fmap_initial", "cycle_error")
    )
    title = "Network of maps"
    edge = traitlets.Int(-1)
    node = traitlets.Unicode("")
    live = (("stage", "budget", "where"), ("stage", "choice"))
    clicks = (("graph", "edge", "choice"), ("graph", "node", "choice"))
    shares = ("edge", "node")

    def build(self) -> list[ipywidgets.Widget]:
        """Return the controls, the graph, the matrix and the views of two surfaces."""
        network = self.study["network"].dataset
        self.source, self.target = (network[key].values.astype(str) for key in ("source", "target"))
        names, ends = np.unique([self.source, self.target], return_inverse=True)
        self.names, self.ends = names.tolist(), ends.reshape(2, -1).T  # (map, 2)
        self.pairs = [tuple(pair) for pair in np.sort(self.ends, axis=1).tolist()]
        self.median = attribute(self.study, "latent", "median")
        self.flagged = set(flagged_names(self.study))
        spectra = [self.study["coarse"][name]["eigenvalue"].values for name in self.names]
        k = network.sizes["eigenpair_source_initial"]  # as in the choice of pairs of the study
        self.distance = spectral_distance([values[:k] for values in spectra])
        n, self.used = len(self.names), len(set(self.pairs))  # pairs that have maps
        most = max(n - 1, n * (n - 1) // 2)
        options: list = labelled(self.study, self.names)
        if n <= MOST:  # of more, the maps are chosen in the graph
            maps = zip(self.source, self.target, strict=True)
            options += [(f"{source} → {target}", i) for i, (source, target) in enumerate(maps)]
        self.stage = dropdown("colours", WHICH, STAGES, layout={"width": "23em"})
        self.budget = int_slider("pairs", BUDGET, self.used, n - 1, most, continuous_update=True)
        self.choice = dropdown("show", SHOW, options, layout=NARROW)
        arrangements = ["circle", "shape differences"]
        self.where = dropdown("positions", POSITIONS, arrangements, layout=NARROW)
        self.facts, self.bar = ipywidgets.HTML(), ipywidgets.HTML()
        self.graph, self.matrix = Chart(), Chart()
        self.scenes = [self.new_scene(185), self.new_scene(185)]
        self.redraw(self.draw, self.where, self.budget)
        self.redraw(self.change_stage, self.stage)
        self.on_change(self.choice, self.select)
        self.on_pick(self.graph, lambda mark: self.select(mark.get("edge", mark.get("node"))))
        self.on_change(self, self.show_edge, "edge")
        self.on_change(self, self.show_node, "node")
        self.draw()
        self.node = self.median or self.names[0]
        parts = ipywidgets.VBox([self.graph, self.bar]), self.matrix, ipywidgets.VBox(self.scenes)
        return [
            row(self.stage, self.choice, self.where),
            row(self.budget, self.facts),
            columns(*parts, min_width="20em"),
        ]

    def selection(self) -> dict:
        """Return the pair whose map is shown, or the shape that is shown alone."""
        if self.edge < 0:
            return {"pair": ("", ""), "shape": self.node}
        return {"pair": (str(self.source[self.edge]), str(self.target[self.edge]))}

    def adopt(self, pair: tuple[str, str], shape: str) -> None:
        """Show the map of the pair, if it has one; else the shape, if no map is shown."""
        for edge in np.flatnonzero((self.source == pair[0]) & (self.target == pair[1])):
            self.edge = int(edge)
        if self.edge < 0 and shape in self.names:
            self.node = shape

    def positions(self, names: list[str]) -> Array:
        """Return positions ``(n, 2)`` of nodes, by shape differences or on a circle."""
        positions = None
        if self.where.value == "shape differences":
            positions = network_positions(self.study, names)
        return charts.on_circle(len(names)) if positions is None else positions

    def drawn_shapes(self, pairs: Array) -> Array:
        """Return the shapes in the graph of some pairs, as indices of `names` ``(n,)``."""
        if len(self.names) <= MOST:
            return np.arange(len(self.names))
        first = [self.node] if self.edge < 0 else [self.source[self.edge], self.target[self.edge]]
        if self.node:
            first[0] = self.node
        known = [self.names.index(name) for name in (*first, self.median) if name in self.names]
        return nearest_by_maps(pairs, len(self.names), known, MOST)

    def budgeted(self) -> Array:
        """Return the pairs ``(p, 2)`` within the budget: those of the study, or another choice."""
        if self.budget.value == self.used:
            return np.unique(self.pairs, axis=0)
        return choose_pairs(self.distance, self.budget.value)

    def draw(self) -> None:
        """Draw the graph of the pairs within the budget, on one colour scale before and after."""
        network = self.study["network"].dataset
        low, high = network_limits(self.study)
        pairs = self.budgeted()
        allowed = {tuple(pair) for pair in pairs.tolist()}
        self.allowed = [i for i, pair in enumerate(self.pairs) if pair in allowed]
        drawn = self.drawn_shapes(pairs)
        names = [self.names[i] for i in drawn]
        index = np.full(len(self.names), -1)  # in the graph
        index[drawn] = np.arange(len(drawn))
        between = (index[self.ends] >= 0).all(axis=1)  # maps of which both shapes are drawn
        self.shown = [i for i in self.allowed if between[i]]
        values = network[self.stage.value].values
        colors = cycle_error_colors(values[self.shown], (low, high))
        source, target = index[self.ends[self.shown]].T
        x, y = self.positions(names).T
        n = len(self.names)
        part = "" if len(names) == n else f" (the nearest {len(names)} of {n:,})"
        self.graph.draw(
            "graph",
            x=x,
            y=y,
            names=names,
            source=source,
            target=target,
            colors=[to_hex(color) for color in colors],
            values=values[self.shown],
            weights=network["weight"].values[self.shown],
            label="cycle error",
            unknown=UNKNOWN,
            title=f"Click a shape or a map{part}",
            faint=[name in self.flagged for name in names],
            highlight=names.index(self.median) if self.median in names else -1,
            node=names.index(self.node) if self.node in names else -1,
            edge=self.edge,
            edges=self.shown,
        )
        self.show_facts(pairs, values[self.allowed])
        self.bar.value = PARTS.color_bar(color_scale(CYCLE_ERROR, low, high, ERRORS))

    def show_facts(self, pairs: Array, values: Array) -> None:
        """Show connectivity and cycle errors of the graph of some pairs."""
        facts, known = connectivity(pairs, len(self.names)), values[np.isfinite(values)]
        excluded = excluded_of(self.study["registration"]) if "registration" in self.study else []
        few = len(self.allowed) < 2 * len(pairs)
        parts = [
            f"{len(pairs)} pairs" + f", the study has {len(self.allowed)} maps of them" * few,
            f": {'connected' if facts['components'] == 1 else 'NOT connected'}, ",
            f"{facts['triangles']} triangles, {facts['in_no_triangle']} shapes in none, ",
            f"smallest degree {facts['smallest_degree']}, diameter {facts['diameter']}",
        ]
        if len(known):
            parts.append(f"; cycle errors {known.min():.3f} to {known.max():.3f}, ")
            parts.append(f"median {np.median(known):.3f}")
        if excluded:
            parts.append(f"; excluded (flagged): {', '.join(excluded)}")
        self.facts.value = PARTS.paragraph("".join(parts))

    def change_stage(self) -> None:
        """Show the maps before or after Consistent ZoomOut."""
        if self.edge >= 0:
            self.show_edge(self.edge)
        else:
            self.draw()

    def select(self, item: int | str) -> None:
        """Select a map by its row of ``/network``, or a shape by its name."""
        if isinstance(item, str):
            self.node = item
        else:
            self.edge = item

    def show_node(self, name: str) -> None:
        """Show a shape."""
        if not name:
            return
        self.edge = -1
        self.choice.value = name
        scene, other = self.scenes
        self.matrix.layout.display = other.layout.display = "none"
        scene.show(*surface(self.study, name), title=name)
        n_from, n_to = (self.source == name).sum(), (self.target == name).sum()
        scene.caption = f"{n_from} maps from this shape, {n_to} to it"
        self.draw()

    def show_edge(self, edge: int) -> None:
        """Show a map: its matrix, and the colours that it transfers from source to target."""
        if edge < 0:
            return
        if len(self.names) <= MOST:
            self.choice.value = edge
        self.node = ""
        pair = self.study["network"].dataset.isel(pair=edge)
        C = pair["fmap" if self.stage.value == "cycle_error" else "fmap_initial"].values
        source, target = names = str(self.source[edge]), str(self.target[edge])
        on_source, on_target = self.scenes
        self.matrix.layout.display = on_target.layout.display = ""
        self.matrix.matrix(C, title=f"{source} → {target}, {len(C)} × {len(C)}", note=DIRECTION)
        bases = [self.study["coarse"][name].dataset["eigenfunction"].values for name in names]
        match = match_from_fmap(C, *bases)
        X, T = surface(self.study, source)
        colors = position_colors(X)
        on_source.show(X, T, colors, f"{source}, the source")
        on_target.show(*surface(self.study, target), colors[match], f"{target}, the target")
        error, weight = pair[self.stage.value].item(), pair["weight"].item()
        error = UNKNOWN if np.isnan(error) else f"{error:.3f}"
        on_source.caption = "its coordinates as colours"
        on_target.caption = (
            f"the colours transferred by the map; cycle error {error}, weight {weight:.2f} in "
            "Consistent ZoomOut"
        )
        self.draw()
