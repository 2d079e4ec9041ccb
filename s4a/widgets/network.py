"""The network of maps (3.4): shapes, the maps among them, and how well they close their cycles."""

import ipywidgets
import numpy as np
import traitlets
from matplotlib import colormaps
from matplotlib.colors import ListedColormap, to_hex

from s4a.method.fmap import match_from_fmap
from s4a.method.network import choose_pairs, connectivity, spectral_distance
from s4a.show import charts
from s4a.show.draw import position_colors
from s4a.show.live import color_bar
from s4a.show.pictures import names_of
from s4a.widgets.chart import chart
from s4a.widgets.meshes import camera_group, surface
from s4a.widgets.panel import Panel, beside, paragraph, row
from s4a.widgets.scene import scene

STAGES = [
    ("after Consistent ZoomOut", "cycle_error"),
    ("before Consistent ZoomOut", "cycle_error_initial"),
]


# without the bright end, which is hard to see on white
ERRORS = ListedColormap(colormaps["viridis_r"](np.linspace(0.15, 1, 256)))


class Network(Panel):
    """Shapes as nodes, maps as edges coloured by cycle error; a click shows the meshes and the map.

    Attributes
    ----------
    edge : int
        Row of ``/network`` that is shown, -1 for none.
    node : str
        The shape that is shown alone, "" for none.
    """

    needs = ("network/source", "network/target", "network/fmap", "network/cycle_error")
    title = "Network of maps"
    edge = traitlets.Int(-1)
    node = traitlets.Unicode("")
    live = (("stage", "budget", "where"), ("stage", "choice"))
    clicks = (("graph", "edge", "choice"), ("graph", "node", "choice"))

    def build(self, view="corner", up="z"):
        """Choices, graph, matrix and two surfaces."""
        network = self.study["network"].dataset
        self.source, self.target = (network[key].values.astype(str) for key in ("source", "target"))
        self.names = [str(name) for name in np.unique(np.r_[self.source, self.target])]
        self.ends = (
            np.searchsorted(self.names, self.source),
            np.searchsorted(self.names, self.target),
        )
        spectra = [self.study["coarse"][name]["eigenvalue"].values for name in self.names]
        k = min(20, *(len(values) for values in spectra))
        self.distance = spectral_distance([values[:k] for values in spectra])
        n = len(self.names)
        self.stage = ipywidgets.Dropdown(
            options=STAGES, description="colours", layout={"width": "320px"}
        )
        used = len(
            {tuple(sorted(pair)) for pair in zip(*(end.tolist() for end in self.ends), strict=True)}
        )
        self.budget = ipywidgets.IntSlider(
            used,
            min=n - 1,
            max=max(n - 1, n * (n - 1) // 2),
            description="pairs",
            layout={"width": "340px"},
        )
        options = [
            *((name, name) for name in self.names),
            *((f"{s} → {t}", i) for i, (s, t) in enumerate(self.directed())),
        ]
        self.choice = ipywidgets.Dropdown(options=options, description="show")
        self.where = ipywidgets.Dropdown(
            options=["circle", "shape differences"], description="places"
        )
        self.on_change(self.where, lambda _: self.draw())
        self.facts, self.bar = ipywidgets.HTML(), ipywidgets.HTML()
        self.graph, self.matrix = chart(), chart()
        group = camera_group()
        self.scenes = [scene(group=group, view=view, up=up, height=300) for _ in range(2)]
        self.on_change(
            self.stage, lambda _: self.show_edge(self.edge) if self.edge >= 0 else self.draw()
        )
        self.on_change(self.budget, lambda _: self.draw())
        self.on_change(self.choice, self.choose)
        self.on_change(self.graph, self.pick, "picked")
        self.on_change(self, self.show_edge, "edge")
        self.on_change(self, self.show_node, "node")
        self.draw()
        self.node = str(self.study["latent"].attrs.get("median", "")) or self.names[0]
        return [
            row(self.stage, self.choice, self.where),
            row(self.budget, self.facts),
            beside(ipywidgets.VBox([self.graph, self.bar]), self.matrix),
            beside(*self.scenes),
        ]

    def directed(self):
        """Names of source and target of every map."""
        return list(zip(self.source, self.target, strict=True))

    def layout_of_nodes(self):
        """Places ``(n, 2)``: a circle.

        Or the first two components of the area-based shape differences.
        """
        latent = self.study["latent"].dataset
        if (
            self.where.value == "circle"
            or latent.sizes.get("difference_component", 0) < 2
            or not set(self.names) <= set(names_of(latent))
        ):
            return charts.on_circle(len(self.names))
        return latent["area_score"].sel(shape=self.names).values[:, :2]

    def draw(self):
        """The graph with the pairs that the budget allows, on one colour scale before and after."""
        network = self.study["network"].dataset
        values = network[self.stage.value].values
        top = float(np.nanmax([network[key].values for _, key in STAGES], initial=0)) or 1.0
        pairs = choose_pairs(self.distance, self.budget.value)
        kept = {tuple(pair) for pair in pairs.tolist()}
        ends = np.sort(np.stack(self.ends, axis=1), axis=1).tolist()
        self.shown = [i for i, pair in enumerate(ends) if tuple(pair) in kept]
        share = np.nan_to_num(values[self.shown] / top, nan=0.0)
        places = self.layout_of_nodes()
        median = str(self.study["latent"].attrs.get("median", ""))
        self.graph.draw(
            "graph",
            x=places[:, 0],
            y=places[:, 1],
            names=self.names,
            source=self.ends[0][self.shown],
            target=self.ends[1][self.shown],
            colors=[to_hex(color) for color in ERRORS(share)],
            values=values[self.shown],
            weights=network["weight"].values[self.shown],
            label="cycle error",
            title="Click a shape or a map",
            highlight=self.names.index(median) if median in self.names else -1,
            node=self.names.index(self.node) if self.node in self.names else -1,
            edge=self.edge,
            edges=self.shown,
        )
        self.tell(pairs, values[self.shown], top)

    def tell(self, pairs, values, top):
        """Numbers of the graph, and what its colours mean."""
        c = connectivity(pairs, len(self.names))
        held = (
            f", {len(self.shown)} maps of them in the study"
            if len(self.shown) < 2 * len(pairs)
            else ""
        )
        known = values[np.isfinite(values)]
        middle = f"; median cycle error {np.median(known):.3f}" if len(known) else ""
        self.facts.value = paragraph(
            f"{len(pairs)} pairs{held}: {'connected' if c['components'] == 1 else 'NOT connected'}, "
            f"{c['triangles']} triangles, {c['in_no_triangle']} shapes in none, smallest degree "
            f"{c['smallest_degree']}, at most {c['diameter']} maps apart{middle}"
        )
        colors = ",".join(color_bar(ERRORS, 0, top, "")["colors"])
        self.bar.value = (
            f'<div style="max-width:420px;height:12px;background:linear-gradient(90deg,{colors})"></div>'
            f'<div style="max-width:420px;display:flex;justify-content:space-between"><span>0</span>'
            f"<span>cycle error, first modes</span><span>{top:.2f}</span></div>"
        )

    def pick(self, mark):
        """What was clicked in the graph."""
        self.choose(mark["edge"] if "edge" in mark else mark["node"])

    def choose(self, what):
        """A map by its row of ``/network``, or a shape by its name."""
        if isinstance(what, str):
            self.node = what
        else:
            self.edge = what

    def show_node(self, name):
        """One shape."""
        if not name:
            return
        self.edge = -1
        self.choice.value = name
        self.matrix.layout.display = self.scenes[1].layout.display = "none"
        self.scenes[0].show(*surface(self.study, name), title=name)
        self.scenes[
            0
        ].caption = (
            f"{(self.source == name).sum()} maps from it, {(self.target == name).sum()} to it"
        )
        self.draw()

    def show_edge(self, edge):
        """A map: its matrix, and the colours that it carries from source to target."""
        if edge < 0:
            return
        self.choice.value = edge
        self.node = ""
        network = self.study["network"].dataset.isel(pair=edge)
        key = "fmap" if self.stage.value == "cycle_error" else "fmap_initial"
        C, names = network[key].values, (str(self.source[edge]), str(self.target[edge]))
        self.matrix.layout.display = self.scenes[1].layout.display = ""
        self.matrix.matrix(C, title=f"{names[0]} → {names[1]}, {len(C)} × {len(C)}")
        (X, T), (Y, S) = (surface(self.study, name) for name in names)
        bases = (self.study["coarse"][name]["eigenfunction"].values for name in names)
        colors = position_colors(X)
        self.scenes[0].show(X, T, colors, f"{names[0]}, the source")
        self.scenes[1].show(Y, S, colors[match_from_fmap(C, *bases)], f"{names[1]}, the target")
        error, weight = network[self.stage.value].item(), network["weight"].item()
        self.scenes[0].caption = "its coordinates as colours"
        self.scenes[
            1
        ].caption = (
            f"the colours that the map carries; cycle error {error:.3f}, weight {weight:.2f}"
        )
        self.draw()
