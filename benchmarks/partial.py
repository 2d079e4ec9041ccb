"""Parts of shapes completed by a study: errors and intervals, beside rustcpd's posterior.

``partial.py [brains faces skulls] [--few] [--alone] [--seed N ...] [--studies FOLDER]``: new
shapes, of which a plane with a random direction cuts off 0, 10, 30 or 50 % of the vertices, turned
at random by 45 degrees, into studies that lack them: 12 synthetic brains of 6,000 vertices and 8
others, 16 faces drawn from a published model (its mean face and 24 modes, with normal scores) and 8
others, and five mouse skulls, each into a study of the four others.  For each cut the mean over the
shapes of: CPU seconds; distance to the truth where the part is, in % of sqrt(area), of the whole
shape inserted, of the part, of rustcpd; the same where it is not, with that of the mean shape laid
on the truth of what is there alone; the share of coordinates that lie within intervals of 50, 80
and 90 % where nothing is, around the truth, and around the match of the whole; where the part is,
of 90 %; and where nothing is, rustcpd's of 90 %.  Skulls have no truth but the match of the whole.
Parts that are refused are counted, and in no mean.

rustcpd gets the mean and the modes of the same study and the same part: ``pose_initialize`` (with
translation anchors and adaptive mixing, as it says for partial targets), ``register_atlas``,
``posterior``; ``--alone`` goes without it.  ``--few`` takes two shapes of each set, ``--seed N``
other brains and faces than those of 3, ``--studies`` keeps the studies in a folder.

``--seed`` with several numbers (``4 6-8``) makes a study of each.  The shapes of all are numbered
on, and each is cut by planes of its own: those of the first eight are the same for every seed
alone.  At the end all are pooled: the mean of every share, its standard error as if all shapes were
independent and as if those of one study were alike in part, and the least and the largest share of
single shapes.

``--left-out`` has no new shapes: of the eleven brains of the study beside its template the same
part is missing, which a plane of random direction cuts off the mean shape, six for each share (two
with ``--few``), and each is reported by the others with the factor and the share of the others.
For each cut: the parts of shapes; the share of coordinates where nothing is that lie within
intervals of 90 % around the truth, and with all of the variance between ways; and the median of
cov(p, e) / var(e), with p what is reported less the match and e the match less the truth, where
nothing is, with what stands for e in a study, the match less the direct way, and both where the
part is.  The planes are the same for every seed; of several the two shares are pooled, with the
standard error between studies.
"""

import logging
import subprocess
import sys
import tempfile
import time
import warnings
from itertools import takewhile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import s4a
import s4a_morphometrics
from s4a import synthetic
from s4a.analysis.inputs import registration_of
from s4a.geometry.align import farthest_points, rigid_transform
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a_morphometrics import posterior
from s4a_morphometrics.calibration import (
    calibrate,
    image_of,
    leave_out_parts,
    path_differences,
    pose_of,
    regression_slope,
)
from s4a_morphometrics.part import cut
from s4a_morphometrics.partial import model_of

DATA = Path(__file__).parents[2] / "shared" / "data"
OPTIONS = {"n_coarse": 2000, "k_init": 20, "k": 60, "n_jobs": 1}
SHARES = 0.0, 0.1, 0.3, 0.5
LEVELS = 0.6745, 1.2816, 1.6449  # of 50, 80 and 90 %
HEAD = (
    "missing",
    "of the area",
    "CPU s",
    "there: whole",
    "part",
    "rustcpd",
    "missing: part",
    "rustcpd",
    "mean shape",
    "truth in 50 %",
    "80 %",
    "90 %",
    "match in 50 %",
    "80 %",
    "90 %",
    "there: truth in 90 %",
    "match in 90 %",
    "missing: rustcpd, truth in 90 %",
    "refused",
)
HEAD_LEFT_OUT = (
    "missing",
    "parts of shapes",
    "truth in 90 %",
    "with all of the ways",
    "cov(p, e) / var(e)",
    "with the direct way",
    "there: cov(p, e) / var(e)",
    "with the direct way",
)


def study_of_brains(store, seed):
    """Study of the first twelve, all meshes, and true positions of the template's vertices."""
    tree = synthetic.brains(20, 6000, seed=seed)
    names = sorted(tree["original"].children)
    meshes = {name: tree["original"][name].to_dataset() for name in names}
    study = s4a.analyse({n: meshes[n] for n in names[:12]}, store=store, **OPTIONS)
    u = tree["truth"][study["registration"].attrs["template"]]["reference_point"].values
    return study, meshes, {n: synthetic.position(tree["truth"], n, u) for n in names}


def brains(_folder, store, few, seed):
    """Study, new mesh and true position of the template's vertices, shape by shape."""
    study, meshes, true = study_of_brains(store, seed)
    for name in sorted(meshes)[12 : 12 + few]:
        yield study, meshes[name], true[name]


def faces(folder, store, few, seed):
    """The files of the model are its modes, the largest first: no two are of one population."""
    mean, *modes = (
        s4a.read_shape(file)["position"].values
        for file in (
            folder / "faces" / "generic_neutral_mesh.ply",
            *sorted((folder / "faces").glob("identity*.ply")),
        )
    )
    scores = np.random.default_rng(seed).normal(size=(24, len(modes)))
    drawn = mean + np.einsum("sm,mnx->snx", scores, np.array(modes) - mean)
    T = as_arrays(s4a.read_shape(folder / "faces" / "generic_neutral_mesh.ply"))[1]
    study = s4a.analyse({f"face_{i:02d}": (drawn[i], T) for i in range(16)}, store=store, **OPTIONS)
    for X in drawn[16 : 16 + few]:
        yield study, as_dataset(X, T), X  # vertex i is vertex i


def skulls(folder, store, few, _seed):
    files = sorted((folder / "skulls").glob("*.ply"))
    for i, file in enumerate(files[:few]):
        others = [str(other) for other in files if other != file]
        study = s4a.analyse(others, store=store.with_name(f"{store.name}_{i}"), **OPTIONS)
        yield study, s4a.read_shape(file), None


def drift(study, X):
    """Rustcpd's completed shape and standard deviation of a coordinate at every vertex."""
    import rustcpd

    registration, modes = (study[node].to_dataset() for node in ("registration", "pca"))
    size = np.sqrt(vertex_areas(*as_arrays(registration)).sum())
    mean = (registration["position"] + modes["mean_displacement"]).values / size
    target = X[farthest_points(X, 1500)] / size
    few = np.sort(farthest_points(mean, 1500))
    deformation = modes["deformation"].values / size  # (c, n, 3)
    c = len(deformation)
    variance = (modes["standard_deviation"].values / size) ** 2
    columns = deformation / np.sqrt(variance)[:, None, None]
    every, some = (
        np.ascontiguousarray(part.transpose(1, 2, 0).reshape(-1, c))
        for part in (columns, columns[:, few])
    )
    partial = {"with_scale": False, "adaptive_mixing": 1.0, "outlier_weight": 0.05}
    start = rustcpd.pose_initialize(
        mean[few], target, some, variance, translation_anchor_count=6, **partial
    )
    fit = rustcpd.register_atlas(
        target, mean[few], some, variance, initial_state=start.state, **partial
    )
    found = fit.posterior(target, mean, every, variance)
    sd = np.sqrt(np.asarray(found.predictive_variance()) / 3)
    return size * np.asarray(found.predict()), size * sd


def shares_within(error, sd, rows):
    """Shares of the coordinates of some vertices within the intervals of each level."""
    if not rows.any():
        return [np.nan] * len(LEVELS)
    ratio = np.abs(error / sd)[rows]
    return [float((ratio <= level).mean()) for level in LEVELS]


def whole_inserted(study, mesh):
    """The template's vertices on a new shape in its file, as its whole is matched."""
    new = s4a.insert(study, {"new": mesh}, compare=False)
    return image_of(new["registration"].to_dataset().isel(shape=0))


def row_of(study, mesh, true, of_whole, share, rng, *, alone=False):
    """What is measured of one cut of one shape, with nan of rustcpd where S4A is `alone`."""
    template = study["registration"].to_dataset()
    area = vertex_areas(*as_arrays(template))
    unit = 100 / np.sqrt(area.sum())
    true = of_whole if true is None else true
    X, T = as_arrays(mesh)
    direction = rng.normal(size=3)
    height = X @ direction
    level = np.quantile(height, 1 - share)
    part, triangles = cut(X, T, height <= level)
    there = true @ direction <= level
    axis = rng.normal(size=3)
    Q = Rotation.from_rotvec(np.pi / 4 * axis / np.linalg.norm(axis)).as_matrix()
    spent = time.process_time()
    try:
        found = s4a_morphometrics.complete(study, (part @ Q.T, triangles), n_samples=0)
    except ValueError as error:
        sys.stderr.write(f"refused: {error}\n")
        return None
    spent = time.process_time() - spent
    sd = found["completion_sd"].values
    image = found["position"].values
    if alone:
        others, others_sd = np.full_like(image, np.nan), np.full(len(image), np.nan)
    else:
        others, others_sd = drift(study, part @ Q.T)

    def distance(points, rows):
        gap = np.linalg.norm(points - true, axis=1)
        return unit * gap[rows] @ area[rows] / area[rows].sum() if rows.any() else np.nan

    mean = template["position"].values + study["pca"]["mean_displacement"].values
    R, t, _ = rigid_transform(mean[there], true[there], area[there])
    in_truth = shares_within(image - true @ Q.T, sd, ~there)
    in_match = shares_within(image - of_whole @ Q.T, sd, ~there)
    return [
        found.attrs["missing"],
        spent,
        distance(of_whole, there),
        distance(image @ Q, there),
        distance(others @ Q, there),
        distance(image @ Q, ~there),
        distance(others @ Q, ~there),
        distance(mean @ R.T + t, ~there),
        *in_truth,
        *in_match,
        shares_within(image - true @ Q.T, sd, there)[-1],
        shares_within(image - of_whole @ Q.T, sd, there)[-1],
        np.nan if alone else shares_within(others - true @ Q.T, others_sd[:, None], ~there)[-1],
    ]


def wrong_of(model, true):
    """By how much the match of each shape of a study is off the truth, at low resolution."""
    registration = registration_of(model.study)
    return {
        name: model.X + field - pose_of(model, registration.sel(shape=name))(true[name][model.at])
        for name, field in zip(registration["shape"].values.tolist(), model.fields, strict=True)
    }


def parts_of(model, share, n):
    """Which vertices of the template `n` planes leave, and the density to tell the others with."""
    rng = np.random.default_rng(round(10 * share))
    for direction in rng.normal(size=(n, 3)):
        height = (model.X + model.fields.mean(0)) @ direction
        present = height <= np.quantile(height, 1 - share)
        known = posterior.know(
            model.fields, model.template.low.Phi, model.X, model.area, present, scale=model.scale
        )
        yield present, posterior.best_density(known, ~present)[0]


def rows_of_left_out(found, gaps, wrong):
    """What is measured of the same part of each shape, told by the others; nan without a gap."""
    for name, one in found.items():
        others = {n: other for n, other in found.items() if n != name}
        again = calibrate(others, {n: gap for n, gap in gaps.items() if n != name})
        at, p, deviation = one.missing
        e = wrong[name]
        variance = (again.factor * deviation[:, None]) ** 2
        every = np.ones(len(at), bool)
        within = [
            shares_within(p + e[at], np.sqrt(variance + more), every)[-1]
            for more in (again.added, again.paths)
        ]
        ratios = [
            regression_slope(part.error, of[name][part.at]) if name in of else np.nan
            for part in (one.missing, one.present)
            for of in (wrong, gaps)
        ]
        yield [*within, *ratios]


def left_out(store, n_planes, seed):
    """The table of shapes of a study that are reported by the others, and the rows of each share.

    Rows are those of all shapes with the first plane, then with the second, and so on.
    """
    study, _, true = study_of_brains(store, seed)
    model = model_of(study)
    gaps, wrong = path_differences(model), wrong_of(model, true)
    sys.stdout.write(f"\nbrains of seed {seed}, left out\n\n{heading(HEAD_LEFT_OUT)}")
    tables = {}
    for share in SHARES[1:]:
        rows = [
            row
            for present, density in parts_of(model, share, n_planes)
            for row in rows_of_left_out(leave_out_parts(model, present, density), gaps, wrong)
        ]
        table = tables[share] = np.array(rows)
        told = [*table[:, :2].mean(0), *np.nanmedian(table[:, 2:], 0)]
        sys.stdout.write(line(share, [str(len(rows)), *(f"{value:.3f}" for value in told)]))
        sys.stdout.flush()
    return tables


def pooled_left_out(of_seeds):
    """The table of the shapes left out of several studies, seed -> rows as of :func:`left_out`."""
    lines = heading([*HEAD_LEFT_OUT[:2], *(f"{n} (standard error)" for n in HEAD_LEFT_OUT[2:4])])
    for share in SHARES[1:]:
        table = np.concatenate([of[share] for of in of_seeds.values()])
        study = np.repeat(list(of_seeds), [len(of[share]) for of in of_seeds.values()])
        of_each = [
            f"{values.mean():.3f} ({standard_error(values, study):.3f})" for values in table.T[:2]
        ]
        lines += line(share, [str(len(table)), *of_each])
    return lines


def heading(names):
    """The first two lines of a table."""
    return f"| {' | '.join(names)} |\n|{' --- |' * len(names)}\n"


def line(share, cells):
    """The line of a table with what is missing and these cells."""
    return f"| {100 * share:.0f} % | {' | '.join(cells)} |\n"


def cuts(name, folder, keep, seed, few, *, first=0, alone=False):
    """Share of missing -> what is measured of each new shape of one study, None where refused.

    The planes depend on the number of the shape, of which that of the first is given.
    """
    rows = {share: [] for share in SHARES}
    new_shapes = globals()[name](folder, keep / f"study_{name}_{seed}", few, seed)
    for i, new in enumerate(new_shapes, first):
        of_whole = whole_inserted(*new[:2])
        for share in SHARES:
            rng = np.random.default_rng([i, round(10 * share)])
            rows[share].append(row_of(*new, of_whole, share, rng, alone=alone))
    return rows


def told(rows):
    """The table of the new shapes of one study."""
    lines = heading(HEAD)
    for share, of_cut in rows.items():
        found = [row for row in of_cut if row is not None]
        means = np.mean(found, 0) if found else [np.nan] * (len(HEAD) - 2)
        cells = [f"{value:.3f}" if value == value else "-" for value in means]
        lines += line(share, [*cells, str(len(of_cut) - len(found))])
    return lines


def standard_error(values, group):
    """Of a mean, where values of one group are alike in part.

    What those of a group lie off the mean counts as one draw.
    """
    off, groups = values - values.mean(), np.unique(group)
    sums = np.array([off[group == one].sum() for one in groups])
    return float(np.sqrt((sums**2).sum() * len(groups) / (len(groups) - 1)) / len(values))


def pooled(of_seeds):
    """The table of the new shapes of several studies, seed -> rows as of :func:`cuts`."""
    columns = [i for i, name in enumerate(HEAD[1:-1]) if "%" in name and "rustcpd" not in name]
    names = [f"{HEAD[1 + i]} (standard errors; least, largest)" for i in columns]
    lines = heading(["missing", "shapes", *names])
    for share in SHARES:
        rows = [(n, row) for n, of in of_seeds.items() for row in of[share] if row is not None]
        study, table = np.array([n for n, _ in rows]), np.array([row for _, row in rows])
        cells = []
        for values in table[:, columns].T:
            alone, together = (standard_error(values, of) for of in (np.arange(len(rows)), study))
            ends = f"{alone:.3f}, {together:.3f}; {values.min():.2f}, {values.max():.2f}"
            cells.append(f"{values.mean():.3f} ({ends})" if values.mean() == values.mean() else "-")
        lines += line(share, [str(len(rows)), *cells])
    return lines


def numbers_after(word, words, default):
    """The numbers that follow a word: ``--seed 4 6-8`` are four."""
    if word not in words:
        return [default]
    rest = takewhile(lambda one: one[0].isdigit(), words[words.index(word) + 1 :])
    ends = [[int(end) for end in one.split("-")] for one in rest]
    return [n for own in ends for n in range(own[0], own[-1] + 1)]


def main(words):
    sets = [word for word in words if word in ("brains", "faces", "skulls")]
    sets = sets or ["brains", *(["faces", "skulls"] if DATA.is_dir() else [])]
    seeds, few = numbers_after("--seed", words, 3), "--few" in words
    with tempfile.TemporaryDirectory() as folder:
        if DATA.is_dir() and sets != ["brains"]:
            subprocess.run(
                [sys.executable, DATA / "unpack.py", folder], check=True, stdout=subprocess.DEVNULL
            )
        keep = Path(words[words.index("--studies") + 1] if "--studies" in words else folder)
        if "--left-out" in words:
            left = {
                seed: left_out(keep / f"study_brains_{seed}", 2 if few else 6, seed)
                for seed in seeds
            }
            if len(seeds) > 1:
                sys.stdout.write(f"\nbrains of {len(seeds)} studies, left out\n\n")
                sys.stdout.write(pooled_left_out(left))
            return
        for name in sets:
            of_seeds, before = {}, 0
            for seed in seeds:
                given = name, Path(folder), keep, seed, 2 if few else 8
                rows = cuts(*given, first=before, alone="--alone" in words)
                of_seeds[seed] = rows
                n = len(rows[SHARES[0]])
                before += n
                sys.stdout.write(f"\n{name}, {n} new shapes, seed {seed}\n\n{told(rows)}")
                sys.stdout.flush()
            if len(seeds) > 1:
                sys.stdout.write(f"\n{name}, {len(seeds)} studies\n\n{pooled(of_seeds)}")
                sys.stdout.flush()


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.getLogger("s4a").setLevel(logging.ERROR)
    main(sys.argv[1:])
