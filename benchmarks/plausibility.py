"""Which unusual shapes are flagged: oddities simulated in collections, one at a time.

Synthetic brains, and real collections where the shared data are beside the checkout; the first
four, on which the thresholds were chosen, and others. ``plausibility.py [COLLECTION ...]``.

``plausibility.py registrations [COLLECTION ...]`` registers shapes of known correspondence, one
template to the others of its collection, once as by default and once from initial maps of 10
landmarks, which fail where poses differ a lot; and counts of which failed registrations a run would
tell.

``plausibility.py simulated [COLLECTION ...]`` begins one registration at a time at a wrong
transform, the others of the collection as by default.  Which of them failed the truth alone says:
one that finds its way is a right one.
"""

import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.stats import binomtest

import s4a
from s4a.geometry.mesh import as_arrays, as_dataset, triangle_areas, vertex_areas
from s4a.input import plausibility
from s4a.options import Options
from s4a.study import pair
from s4a.study.quality_control import flagged

DATA = Path(__file__).parents[2] / "shared" / "data"
CHOSEN_ON = ("brains", "cats", "faces", "bodies 0-9")
FILES = {  # collection: folder, those of its sorted files
    "cats": ("cats", slice(None)),
    "faces": ("faces", slice(1, 13)),
    "bodies 0-9": ("faust", slice(10)),
    "bodies 10-19": ("faust", slice(10, 20)),
    "kids": ("kids", slice(None)),
    "heads": ("heads", slice(None)),
    "femurs": ("femurs", slice(None)),
    "vertebrae": ("vertebrae", slice(None)),
    "skulls": ("skulls", slice(None)),
}
KINDS = ("brains", "cats", "femurs", "vertebrae")  # simulated in the others
BASES = 1  # shapes of each collection that every oddity is simulated in
PAIRS = {  # folder, the files of a collection, and the places of its templates among these
    "bodies 0-9": ("faust", list(range(10)), (0,)),
    "bodies 0 and 10-19": ("faust", [0, *range(10, 20)], (0,)),
    "cats": ("cats", list(range(11)), (0,)),
    "bodies 10-19": ("faust", list(range(10, 20)), (0, 3, 6)),
    "remeshed bodies": ("faust15k", list(range(10)), (0, 5)),
    "children": ("kids", list(range(6)), (0, 3)),
}
PAIRS_CHOSEN_ON = tuple(PAIRS)[:3]  # as are the thresholds of s4a.study.quality_control
CORRESPONDING = {"faust15k": 6890}  # of these only the first vertices correspond
WAYS: dict[str, dict] = {"as by default": {}, "10 landmarks": {"init": "landmarks"}}
SIMULATED_IN = {  # as PAIRS
    "bodies 0-9": ("faust", list(range(10)), (0,)),
    "cats": ("cats", list(range(11)), (0,)),
    "faces 1-12": ("faces", list(range(1, 13)), (0,)),
    "bodies 10-19": ("faust", list(range(10, 20)), (3, 6)),
    "faces 13-24": ("faces", list(range(13, 25)), (0,)),
    "children": ("kids", list(range(6)), (0,)),
}
SIMULATED_CHOSEN_ON = tuple(SIMULATED_IN)[:3]
TURNS = {  # along the principal axes of the target, the shortest first
    "half a turn about the longest axis": (-1, -1, 1),
    "half a turn about the middle axis": (-1, 1, -1),
    "half a turn about the shortest axis": (1, -1, -1),
    "mirrored along the shortest axis": (-1, 1, 1),
    "mirrored along the middle axis": (1, -1, 1),
}
RIGHT, FAILED = 3.0, 4.0  # % of sqrt(area): a registration below and above, by its mean error


def hippocampi(most=12):
    """Surfaces around segmented hippocampi, smoothed by a voxel."""
    import nibabel
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    for file in sorted((DATA / "hippocampi_msd").glob("*.nii.gz"))[:most]:
        image = nibabel.load(file)
        inside = np.pad(np.asarray(image.dataobj) > 0, 3).astype(float)
        step = np.abs(np.diag(image.affine)[:3]).astype(float)
        X, T, _, _ = marching_cubes(gaussian_filter(inside, 1.0), 0.5, spacing=step)
        yield file.name.split(".")[0], (X, T)


def collection(name, folder, most=None):
    """Name -> (X, T) of clean shapes, all or the first; femurs all of the right side."""
    if name == "brains":
        tree = s4a.synthetic.brains(12, 2500)
        return {n: as_arrays(m.to_dataset()) for n, m in tree["original"].children.items()}
    if name == "hippocampi":
        return {n: as_arrays(s4a.clean(as_dataset(*m))) for n, m in hippocampi()}
    part, chosen = FILES[name]
    files = sorted((folder / part).glob("*.ply"))[chosen][:most]
    shapes = {file.stem: as_arrays(s4a.read_shape(file)) for file in files}
    return {n: mirrored(*m) if n.endswith("femur_l") else m for n, m in shapes.items()}


def mirrored(X, T):
    return X * [-1, 1, 1], T[:, ::-1]


def scaled(X, T, factor):
    return X * factor, T


def cut(X, T, share):
    """Without the share of the area that lies farthest along the longest axis."""
    area = vertex_areas(X, T)
    axis = np.linalg.eigh(np.cov(X.T, aweights=area))[1][:, 2]
    height = X @ axis
    order = np.argsort(height)
    covered = np.cumsum(area[order]) / area.sum()
    keep = height <= height[order][np.searchsorted(covered, 1 - share)]
    return as_arrays(s4a.clean(as_dataset(X, T[keep[T].all(1)])))


def saved_again(X, T, seed=0):
    """Vertices and triangles in another order, five digits, moved."""
    order = np.random.default_rng(seed).permutation(len(X))
    size = np.ptp(X)
    place = np.argsort(order)
    return np.round(X[order] / size, 5) * size + size, np.roll(place[T][::-1], 1, axis=1)


def oddities(X, T, others):
    """What is simulated: (row of the table, the shape in place of the one that was there)."""
    size = np.ptp(X, axis=0).max()
    yield "mirrored", mirrored(X, T)
    yield "turned by 180 degrees", (X * [1, -1, -1], T)
    yield "scaled by 2.54", scaled(X, T, 2.54)
    yield "scaled by 10, 25.4 or 1000", scaled(X, T, 10)
    yield "scaled by 10, 25.4 or 1000", scaled(X, T, 25.4)
    yield "scaled by 10, 25.4 or 1000", scaled(X, T, 1000)
    for axis in np.eye(3):
        yield "stretched by 2", (X * (1 + axis), T)
        yield "stretched by 1.5", (X * (1 + axis / 2), T)
    for share in (0.1, 0.3, 0.5):
        yield f"{100 * share:.0f} % cut off", cut(X, T, share)
    area = triangle_areas(X, T).sum()
    for what, other in others.items():
        row = what if what == "a sphere" else "another kind, of the same size"
        yield row, scaled(*other, np.sqrt(area / triangle_areas(*other).sum()))
    yield "rounded to 1/40 of the extent", (np.round(X / size * 40) / 40 * size, T)


class Collection:
    """Portraits of shapes, and what is reported with one or some of them replaced."""

    def __init__(self, shapes):
        self.pairs = {}
        self.seconds = 0.0
        self.shapes = shapes
        self.descriptors = {name: self.describe(mesh) for name, mesh in shapes.items()}

    def describe(self, mesh):
        mesh = s4a.clean(as_dataset(*mesh))
        start = time.process_time()
        descriptor = plausibility.describe(mesh, intersections=False)
        self.seconds += time.process_time() - start
        return descriptor

    def compare(self, name, descriptors, references):
        """:func:`plausibility.compare`, with each pair of descriptors compared once."""
        seen = []
        for other in references:
            a, b = descriptors[name], descriptors[other]
            if (id(a), id(b)) not in self.pairs:
                start = time.process_time()
                found = plausibility.compare("" if a is not b else other, a, {other: b})
                self.seconds += time.process_time() - start
                self.pairs[id(a), id(b)] = found, a, b  # held, so that their ids stay theirs
            seen.append(self.pairs[id(a), id(b)][0].assign_coords(reference=[other]))
        both = ["fit", "fit_mirrored", "chirality"]
        return (
            seen[0]
            .drop_dims("reference")
            .assign_attrs(seen[0].attrs)
            .merge(xr.concat([one[both] for one in seen], dim="reference"))
            .assign_attrs(seen[0].attrs)
        )

    def told(self, **simulated):
        """Name -> kinds of flags, those that make it flagged with an exclamation mark."""
        descriptors = self.descriptors | {name: self.describe(m) for name, m in simulated.items()}
        attrs = {name: {"area": one.attrs["surface"]} for name, one in descriptors.items()}
        references = plausibility.pick_references(descriptors)
        seen = {name: self.compare(name, descriptors, references) for name in descriptors}
        flags, _ = plausibility.find_warnings(attrs, seen)
        return {
            name: {one.kind + "!" * one.flagged for one in found}
            for name, found in flags.items()
            if found
        }


def rows_of(name, shapes, others):
    """Row of the table -> its cell for this collection."""
    whole = Collection(shapes)
    clean = whole.told()
    rows = {"clean: told, though nothing is wrong": f"{len(clean)}/{len(shapes)}"}
    rows["CPU seconds a shape"] = f"{whole.seconds / len(shapes):.2f}"
    names = list(shapes)
    found, false = {}, 0
    for base in names[1 :: max(1, len(names) // BASES)][:BASES]:
        for row, mesh in oddities(*shapes[base], others):
            told = whole.told(**{base: mesh})
            before = clean.get(base, set())
            found.setdefault(row, []).append(told.pop(base, set()) - before)
            false += len(set(told) - set(clean))
        told = whole.told(zz=saved_again(*shapes[base]))
        found.setdefault("the same scan, saved again", []).append(told.pop("zz", set()))
        false += len(set(told) - set(clean))
    half = names[1::2]
    for row, change in (
        ("half mirrored", mirrored),
        ("half scaled by 10", lambda *m: scaled(*m, 10)),
    ):
        told = whole.told(**{one: change(*shapes[one]) for one in half})
        simulated = [told.get(one, set()) for one in half]
        others_told = [told.get(one, set()) for one in names if one not in half]
        # which half is the odd one, nobody knows where both are as many
        found[row] = max(simulated, others_told, key=lambda side: sum(map(bool, side)))
    for row, kinds in found.items():
        flagged = sum(any(kind.endswith("!") for kind in one) for one in kinds)
        rows[row] = f"{sum(map(bool, kinds))}/{len(kinds)}" + f" ({flagged})" * (flagged > 0)
    rows["others told beside a simulated one"] = str(false)
    sys.stdout.write(f"{name}: clean {clean}\n")
    for row, kinds in found.items():
        sys.stdout.write(f"    {row}: {[sorted(one) for one in kinds]}\n")
    sys.stdout.flush()
    return rows


def clean_brains():
    """How many shapes of eight clean collections, of different seeds and modes, are reported."""
    sizes = [(7, 2), (7, 6), (7, 6), (9, 6), (7, 2), (8, 3), (20, 6), (6, 4)]  # shapes, modes
    told = {}
    for seed, (n, n_modes) in enumerate(sizes, 20):
        tree = s4a.synthetic.brains(n, 3500, seed, n_modes=n_modes)["original"]
        shapes = {name: as_arrays(mesh.to_dataset()) for name, mesh in tree.children.items()}
        told |= {f"{seed}/{name}": kinds for name, kinds in Collection(shapes).told().items()}
    sys.stdout.write(f"told of {sum(n for n, _ in sizes)} brains of other seeds: {told}\n")


def error_of(template, shape, match, known):
    """Mean distance of matched and true vertices, % of sqrt(area); the files have one numbering."""
    row = template["file_vertex"].values
    became = shape["vertex_of_file"].values
    true = np.where(row < known, became[np.minimum(row, known - 1)], -1)
    X, there = shape["position"].values, true >= 0
    missed = np.linalg.norm(X[match[there]] - X[true[there]], axis=1)
    return 100 * missed.mean() / np.sqrt(shape.attrs["area"])


def registered(name, folder, at, way):
    """For each other shape: error, registration error, mean |distortion| and the flags."""
    part, numbers, _ = PAIRS[name]
    files = sorted((folder / part).glob("*.ply"))
    shapes = {files[i].stem: s4a.read_shape(files[i]) for i in numbers}
    template = shapes.pop(files[numbers[at]].stem)
    study = s4a.register_pairs(
        template, shapes, bidirectional=False, n_coarse=3000, n_jobs=1, **WAYS[way]
    )
    found = study["registration"].to_dataset().load()
    registration_error = dict(
        zip(shapes, found["registration_error"].sel(shape=list(shapes)).values, strict=True)
    )
    size = abs(found["distortion"].sel(shape=list(shapes))).mean("vertex").values
    distortion = dict(zip(shapes, size.tolist(), strict=True))
    of_shapes, of_all = flagged(registration_error, distortion)
    for other, mesh in shapes.items():
        known = CORRESPONDING.get(part, mesh.sizes["file_vertex_index"])
        match = found["registered_match"].sel(shape=other).values
        told = "flagged" if of_all or any(one.flagged for one in of_shapes.get(other, [])) else ""
        told = told or ("warning" if other in of_shapes else "")
        error = error_of(template, mesh, match, known)
        sys.stdout.write(
            f"    {name}, {way}, {files[numbers[at]].stem} -> {other}: error {error:.2f} %, "
            f"registration_error {registration_error[other]:.4f}, times |distortion| "
            f"{registration_error[other] * distortion[other]:.5f}: "
            f"{told or '-'}{' (all)' if of_all else ''}\n"
        )
        sys.stdout.flush()
        yield error, told


def registrations(names):
    """Of how many failed registrations a run would tell, and of how many right ones."""
    table = {}
    with tempfile.TemporaryDirectory() as folder:
        parts = sorted({PAIRS[name][0] for name in names})
        command = [sys.executable, DATA / "unpack.py", folder, *parts]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        for name in names:
            for way in WAYS:
                table[name, way] = [
                    one for at in PAIRS[name][2] for one in registered(name, Path(folder), at, way)
                ]
    tuned = [one for (name, _), of in table.items() if name in PAIRS_CHOSEN_ON for one in of]
    others = [one for (name, _), of in table.items() if name not in PAIRS_CHOSEN_ON for one in of]
    table["all on which thresholds were chosen", ""], table["all others", ""] = tuned, others
    head = ["collection", "initial maps", "pairs", f"failed, over {FAILED:.0f} %"]
    head += ["of these flagged", "only warned of", f"right, under {RIGHT:.0f} %"]
    head += ["of these flagged", "only warned of", "between, told"]
    sys.stdout.write(f"\n| {' | '.join(head)} |\n{'|---' * len(head)}|\n")
    for (name, way), of in table.items():
        failed = [told for error, told in of if error > FAILED]
        right = [told for error, told in of if error < RIGHT]
        between = [told for error, told in of if RIGHT <= error <= FAILED]
        cells = [name, way, len(of)]
        for group in (failed, right):
            cells += [len(group), group.count("flagged"), group.count("warning")]
        cells.append(f"{sum(map(bool, between))}/{len(between)}")
        sys.stdout.write(f"| {' | '.join(map(str, cells))} |\n")


def turned(signs):
    """Replace :func:`s4a.method.initial_map.transform_onto`: first as usual, then wrong."""
    usual = pair.transform_onto

    def transform(source, target):
        R, t = usual(source, target)
        center = target.area @ target.X / target.area.sum()
        axis = np.linalg.eigh(np.cov(target.X.T, aweights=target.area))[1]
        wrong = axis * signs @ axis.T
        return wrong @ R, wrong @ (t - center) + center

    return transform


def judged(name, at, meshes, shapes):
    """Method, error and flags of each registration of a collection, by default and simulated.

    A simulated failure is compared with the default registrations of the others.
    """
    part = SIMULATED_IN[name][0]
    template, *others = [list(shapes)[at], *(n for i, n in enumerate(shapes) if i != at)]
    error, registration_error, distortion = {}, {}, {}
    for way in ("as by default", *TURNS):
        # an initial map of landmarks, as the dense one is repaired by a search
        more = {"init": "landmarks"} if way in TURNS else {}
        options = Options(bidirectional=False, n_coarse=3000, **more)
        for other in others:
            usual = pair.transform_onto
            try:
                pair.transform_onto = turned(TURNS[way]) if way in TURNS else usual
                found, _ = pair.match_shapes(shapes[other], shapes[template], options)
            finally:
                pair.transform_onto = usual
            known = CORRESPONDING.get(part, meshes[other].sizes["file_vertex_index"])
            match = found["registered_match"].values
            error[way, other] = error_of(meshes[template], meshes[other], match, known)
            registration_error[way, other] = float(found.attrs["score"])
            distortion[way, other] = float(abs(found["distortion"]).mean())
            beside = {n: (way if n == other else "as by default", n) for n in others}
            if way == "as by default":
                continue  # told when all are known
            yield (
                way,
                other,
                error[way, other],
                told_of(other, beside, registration_error, distortion),
                (
                    registration_error[way, other],
                    distortion[way, other],
                ),
            )
        if way == "as by default":
            beside = {n: (way, n) for n in others}
            for other in others:
                told = told_of(other, beside, registration_error, distortion)
                yield (
                    way,
                    other,
                    error[way, other],
                    told,
                    (
                        registration_error[way, other],
                        distortion[way, other],
                    ),
                )


def told_of(name, rows, registration_error, distortion):
    """What a run would tell of a shape, where these are its registrations."""
    of_shapes, of_all = flagged(
        {n: registration_error[row] for n, row in rows.items()},
        {n: distortion[row] for n, row in rows.items()},
    )
    if of_all or any(one.flagged for one in of_shapes.get(name, [])):
        return "flagged"
    return "warning" if name in of_shapes else ""


def share(some, of):
    """A share and its 95 % interval by Wilson."""
    if not of:
        return "-"
    low, high = binomtest(some, of).proportion_ci(0.95, "wilson")
    return f"{some}/{of} = {some / of:.3f} ({low:.3f} to {high:.3f})"


def simulated(names):
    """Of how many registrations that were begun wrongly and failed a run would tell."""
    table = {}
    with tempfile.TemporaryDirectory() as folder:
        parts = sorted({SIMULATED_IN[name][0] for name in names})
        command = [sys.executable, DATA / "unpack.py", folder, *parts]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        options = Options(bidirectional=False, n_coarse=3000)
        for name in names:
            part, numbers, places = SIMULATED_IN[name]
            files = sorted((Path(folder) / part).glob("*.ply"))
            meshes = {files[i].stem: s4a.read_shape(files[i]) for i in numbers}
            shapes = {n: pair.shape_of(mesh, options) for n, mesh in meshes.items()}
            for at in places:
                for way, other, error, told, (score, size) in judged(name, at, meshes, shapes):
                    table.setdefault((name, way), []).append((error, told))
                    sys.stdout.write(
                        f"    {name}, {at}, {way}, {other}: error {error:.2f} %, "
                        f"registration_error {score:.4f}, |distortion| {size:.4f}: {told or '-'}\n"
                    )
                    sys.stdout.flush()
    head = "| collection | begun | failed | told | right | told as false positives | between |"
    sys.stdout.write(f"\n{head}\n{'|---' * 7}|\n")
    for (name, way), of in table.items():
        cells = [name, way, *counts(of)]
        sys.stdout.write(f"| {' | '.join(map(str, cells))} |\n")
    for what, chosen in (("on which thresholds were chosen", True), ("only reported", False)):
        of = [
            one
            for (n, _), all_ in table.items()
            if (n in SIMULATED_CHOSEN_ON) == chosen
            for one in all_
        ]
        failed, told, right, vain, _ = counts(of)
        sys.stdout.write(
            f"{what}: told of failed {share(told, failed)}, of right {share(vain, right)}\n"
        )


def counts(of):
    """Failed, of these told; right, of these told; between."""
    failed = [told for error, told in of if error > FAILED]
    right = [told for error, told in of if error < RIGHT]
    between = len(of) - len(failed) - len(right)
    return len(failed), sum(map(bool, failed)), len(right), sum(map(bool, right)), between


def main(names):
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        names = names or (["brains", *FILES, "hippocampi"] if DATA.is_dir() else ["brains"])
        if DATA.is_dir():
            parts = sorted({FILES[name][0] for name in {*names, *KINDS} if name in FILES})
            command = [sys.executable, DATA / "unpack.py", folder, *parts]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        others = {"a sphere": as_arrays(s4a.synthetic.sphere(2000))}
        for kind in KINDS if DATA.is_dir() else KINDS[:1]:
            (others[kind],) = list(collection(kind, Path(folder), 1).values())[:1]
        table = {}
        if "brains" in names:
            clean_brains()
        for name in names:
            mine = {kind: mesh for kind, mesh in others.items() if kind != name}
            table[name] = rows_of(name, collection(name, Path(folder)), mine)
    sys.stdout.write(f"\nsimulated | {' | '.join(table)}\n")
    for row in dict.fromkeys(row for rows in table.values() for row in rows):
        cells = " | ".join(rows.get(row, "") for rows in table.values())
        sys.stdout.write(f"{row} | {cells}\n")


if __name__ == "__main__":
    if sys.argv[1:2] == ["registrations"]:
        registrations(sys.argv[2:] or list(PAIRS))
    elif sys.argv[1:2] == ["simulated"]:
        simulated(sys.argv[2:] or list(SIMULATED_IN))
    else:
        main(sys.argv[1:])
