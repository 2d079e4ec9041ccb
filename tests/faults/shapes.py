"""Faulty files, one function each, in a folder beside ten good shapes."""

import gzip
from dataclasses import dataclass

import numpy as np

from s4a import synthetic, write_mesh
from s4a.geometry.mesh import as_arrays
from s4a.input.files import WRITERS

BUMPS = np.array([[1, 0.4, 0.3], [-0.5, 1, 0.5], [-0.3, -0.8, 0.9], [0.3, -0.5, -1]])
HEIGHTS = np.array([0.9, 0.6, 0.45, 0.3])
SPHERE = as_arrays(synthetic.sphere(300))


def shape(seed=0, n=300):
    """A closed surface of about 100 mm that no reflection and no turn brings onto itself."""
    u, T = SPHERE if n == 300 else as_arrays(synthetic.sphere(n))
    centre = BUMPS / np.linalg.norm(BUMPS, axis=1, keepdims=True)
    height = HEIGHTS * (1 + 0.15 * np.random.default_rng(seed).normal(size=4))
    r = 1 + np.exp(6 * (u @ centre.T - 1)) @ height
    return 40 * r[:, None] * u * [1.4, 1.1, 0.8], T


@dataclass(frozen=True)
class Fault:
    """A cell of the table: its input, the file and the outcome that are promised.

    `make` writes `file` into a folder; `said` must be found in the report's column `where` (or in
    its attribute ``remarks``) for the shape `name`; `outcome` and `change` are for the
    documentation.
    """

    input: str
    file: str
    make: object
    status: str
    said: str
    outcome: str
    change: str
    name: str = ""
    where: str = "reason"

    @property
    def shape(self):
        return self.name or self.file.split(".")[0]


def of(seed, change=lambda X, T: (X, T), suffix=None):
    """What writes a shape, changed, in the format of the name or of another suffix."""

    def make(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        seeds = seed if isinstance(seed, tuple) else (seed,)
        path.write_bytes(WRITERS[suffix or path.suffix](*change(*shape(*seeds)), {}))

    return make


def write(path, X, T):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(WRITERS[".ply"](X, T, {}))


def zero(path):
    path.write_bytes(b"")


def cut(path):
    write(path, *shape())
    path.write_bytes(path.read_bytes()[:-1000])


def text(path):
    X, T = shape()
    write(path, X, T)
    head = path.read_bytes().partition(b"end_header\n")[0]
    # as many digits on every machine, whatever its rounding
    points = (" ".join(f"{number:.15f}" for number in x) for x in X)
    rows = [*points, *("3 " + " ".join(map(str, t)) for t in T)]
    path.write_bytes(head + b"end_header\n" + "\n".join(rows).encode())


def promise(path):
    write(path, *shape())
    path.write_bytes(path.read_bytes().replace(b"vertex 300", b"vertex 9000000"))


def packed(path):
    path.write_bytes(gzip.compress(WRITERS[".ply"](*shape(3), {})))


def bomb(path):
    path.write_bytes(gzip.compress(bytes(2**26 + 2**20), 1))


def utf_16(path):
    path.write_text("".join("v {} {} {}\n".format(*x) for x in shape()[0]), encoding="utf-16")


def two(path):
    path.write_bytes(2 * WRITERS[".ply"](*shape(), {}))


def other_kind(path):
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + np.arange(1000, dtype="<i4").tobytes())


def points(path):
    path.write_text("OFF\n300 0 0\n" + "\n".join("{} {} {}".format(*x) for x in shape()[0]))


def quads(path):
    X, T = shape(4)
    rows = ["v {} {} {}".format(*x) for x in X]
    a, b, c = T[0]
    pair = np.flatnonzero((T == a).any(axis=1) & (T == b).any(axis=1))
    d = np.setdiff1d(T[pair], T[0])[0]
    faces = [[a, d, b, c], *np.delete(T, pair, axis=0).tolist()]
    path.write_text("\n".join(rows + ["f " + " ".join(str(i + 1) for i in f) for f in faces]))


def nan(path):
    X, T = shape(5)
    X[10], X[200] = np.nan, np.inf
    write(path, X, T)


def duplicate_vertices(path):
    X, T = shape(7)
    unconnected = X[T].reshape(-1, 3) + np.random.default_rng(0).uniform(
        -1e-6, 1e-6, (3 * len(T), 3)
    )
    path.write_bytes(WRITERS[".obj"](unconnected, np.arange(len(unconnected)).reshape(-1, 3), {}))


def flat(path):
    X, T = shape(9)
    a, b, c = T[0]
    middle = len(X)
    X = np.r_[X, [(X[a] + X[b]) / 2]]
    write(path, X, np.r_[T[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])


def flipped(path):
    X, T = shape(12)
    T = T.copy()
    T[:100] = T[:100, ::-1]
    write(path, X, T)


def bowtie(path):
    X, T = shape(14)
    u, S = as_arrays(synthetic.sphere(20))
    top = np.argmax(X[:, 2])
    low = np.argmin(u[:, 2])
    Y = 5 * (u - u[low]) + X[top]
    S = np.where(S == low, top, S + len(X))
    write(path, np.r_[X, Y], np.r_[T, S])


def spheres(X, T, *radii):
    for i, radius in enumerate(radii):
        u, S = as_arrays(synthetic.sphere(60))
        X, T = np.r_[X, radius * u + [300 + 300 * i, 0, 0]], np.r_[T, S + len(X)]
    return X, T


def debris(path):
    write(path, *spheres(*shape(16), 4, 5))


def parts(path):
    write(path, *spheres(*shape(17), 30))


def crossing(path):
    X, T = shape(18)
    X[np.argmax(X[:, 2])] *= [1, 1, -1.6]
    write(path, X, T)


def handle(path):
    X, T = as_arrays(synthetic.torus(30, 12, 50, 20))
    write(path, X, T)


def rod(path):
    write(path, SPHERE[0] * [120, 25, 25], SPHERE[1])


def far(path):
    X, T = shape(22)
    path.write_bytes(WRITERS[".obj"](X + 1e6, T, {}))


class Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('a pickle was executed')",))


def pickle(path):
    np.savez(path, V=np.array([Evil()], object), F=np.array([[0, 1, 2]]))


def label(path):
    import nibabel

    array = nibabel.gifti.GiftiDataArray(np.arange(300, dtype=np.int32), "NIFTI_INTENT_LABEL")
    path.write_bytes(nibabel.gifti.GiftiImage(darrays=[array]).to_bytes())


AGAIN = "export the file again"
# fmt: off
FAULTS = [
    Fault("zero-byte file", "zero.ply", zero, "excluded", "found 0 bytes", "excluded", AGAIN),
    Fault("truncated file", "cut.ply", cut, "excluded", "expected 596 rows of face, found",
          "excluded", AGAIN),
    Fault("text in a binary PLY", "text.ply", text, "excluded", "expected .*found", "excluded",
          AGAIN),
    Fault("header that promises more data than the file has", "promise.ply", promise, "excluded",
          "expected 9000000 rows of vertex, found", "excluded before memory is allocated", AGAIN),
    Fault("PLY named .stl", "ply_inside.stl", of(1, suffix=".ply"), "ok",
          "named .stl but read as PLY", "read as the format that it contains", "rename the file"),
    Fault("STL named .ply", "stl_inside.ply", of(2, suffix=".stl"), "ok",
          "named .ply but read as STL", "read as the format that it contains", "rename the file"),
    Fault("compressed file", "packed.ply.gz", packed, "ok", "^$", "read", "nothing to do"),
    Fault("compressed file that unpacks to too much", "bomb.ply.gz", bomb, "excluded",
          "at most 64 MiB expected in .* compressed bytes, found more",
          "excluded at 200 times its size (64 MiB at least, 1 GiB at most)", "unpack it yourself"),
    Fault("text in UTF-16", "utf_16.obj", utf_16, "excluded",
          "text in UTF-16 found: save it as UTF-8", "excluded", "save it as UTF-8"),
    Fault("two PLY in one file", "two.ply", two, "excluded",
          "one mesh expected, found a second PLY at byte", "excluded",
          "write each mesh to a file of its own"),
    Fault("a binary file of another kind", "other_kind.stl", other_kind, "excluded",
          "expected, found an HDF5 file: export the surface", "excluded; never read as STL",
          "export the surface as one of the formats"),
    Fault("points only", "points.off", points, "excluded", "no faces", "excluded",
          "export the surface, not the points"),
    Fault("quads and polygons", "quads.obj", quads, "ok", "^$", "triangulated", "nothing to do"),
    Fault("face index out of range", "beyond.off",
          of(0, lambda X, T: (X, np.r_[T[:-1], [[0, 1, 5000]]])), "excluded",
          r"face indices 0\.\.299 expected for 300 vertices, found 0\.\.5000",
          "excluded before native code", AGAIN),
    Fault("negative face index", "negative.ply",
          of(0, lambda X, T: (X, np.r_[T[:-1], [[0, 1, -7]]])), "excluded",
          r"face indices 0\.\.299 expected for 300 vertices, found -7\.\.",
          "excluded before native code", AGAIN),
    Fault("NaN or infinite coordinates", "nan.ply", nan, "repaired",
          "2 non-finite vertices removed.*1 holes|2 non-finite vertices removed.*2 holes",
          "the vertices and their faces are removed; `file_vertex` has the numbers in the file",
          "`strict=True` excludes the shape; `close_holes=True` closes the holes"),
    Fault("unreferenced vertices", "unreferenced.ply",
          of(6, lambda X, T: (np.r_[np.ones((3, 3)), X], T + 3)), "repaired",
          "3 vertices without triangles dropped", "dropped, `file_vertex` kept", "nothing to do"),
    Fault("duplicate vertices", "duplicate_vertices.obj", duplicate_vertices, "repaired",
          "1488 vertices welded", "welded at 1e-7 of the bounding box, `file_vertex` kept",
          "nothing to do"),
    Fault("STL with unconnected triangles", "unconnected.stl", of(8), "ok", "^$",
          "equal corners are one vertex", "nothing to do"),
    Fault("zero-area faces", "flat.ply", flat, "repaired", "zero-area triangles",
          "long edges flipped to avoid cracks; otherwise dropped", "nothing to do"),
    Fault("faces that repeat a corner", "repeated.ply",
          of(10, lambda X, T: (X, np.r_[T, [[3, 3, 4], [5, 6, 5]]])), "repaired",
          "2 triangles with repeated corners dropped", "dropped", "nothing to do"),
    Fault("duplicate faces", "twice.ply", of(11, lambda X, T: (X, np.r_[T, T[:5]])), "repaired",
          "5 duplicate triangles dropped", "one is kept", "nothing to do"),
    Fault("flipped faces", "flipped.ply", flipped, "repaired", "100 triangles reoriented",
          "reoriented consistently and outwards", "nothing to do"),
    Fault("non-manifold edges", "fin.ply",
          of(13, lambda X, T: (np.r_[X, [[90.0, 90, 90]]], np.r_[T, [[T[0, 0], T[0, 1], len(X)]]])),
          "repaired", "1 non-manifold edge separated",
          "separated into manifold parts; a robust Laplacian if the coarse mesh still has some",
          "`wrap=True` wraps the shape watertight"),
    Fault("bow-tie vertices", "bowtie.ply", bowtie, "repaired",
          "1 vertex added by splitting non-manifold ones", "split", "nothing to do"),
    Fault("holes, open boundary", "hole.ply", of(15, lambda X, T: (X, T[1:])), "ok",
          "1 hole kept as boundary", "kept as boundary", "`close_holes=True` closes each by a fan"),
    Fault("several components", "debris.ply", debris, "repaired",
          r"2 components dropped \([0-9.]+ % of the area\)",
          "the largest is kept; the report gives the share of the area that was dropped",
          '`components=N` or `"all"` keeps more'),
    Fault("components with more than a tenth of the area", "parts.ply", parts, "repaired",
          "dropped components had [0-9]+ % of the area", "the largest is kept, with a warning",
          '`components=N` or `"all"` keeps more', where="warning"),
    Fault("largest component under half of the area", "halves.ply",
          of(0, lambda X, T: (np.r_[X, X + 300, X + 600], np.r_[T, T + len(X), T + 2 * len(X)])),
          "excluded",
          r"the largest of 3 components has .* under half; say how many .* components=3",
          "excluded", '`components=N` or `"all"`'),
    Fault("self-intersections", "crossing.ply", crossing, "ok",
          "triangles intersect others, 2.3 % .others 0.0 %.",
          "counted; warning above 1 % and ten times the count of the others",
          "`wrap=True` makes a surface without; `intersections=False` does not count them",
          where="warning"),
    Fault("genus unlike the others", "handle.ply", handle, "flagged", "genus 1, but 0 in",
          "warning, with the genus of the others",
          "`wrap=True` closes tunnels; or leave the shape out", where="warning"),
    Fault("shape in other units", "metres.ply", of(19, lambda X, T: (X / 1000, T)), "flagged",
          r"times the size of the others, near 10\^-3", "warning with the factor; size is kept",
          "scale the file", where="warning"),
    Fault("mirrored shape", "mirrored.ply", of(20, lambda X, T: (X * [-1, 1, 1], T[:, ::-1])),
          "flagged", "fits as a mirror image",
          "warning with both ICP residuals; not changed; "
          "not detected for nearly symmetric kinds",
          "reflect= mirrors it; or leave it out", where="warning"),
    Fault("shape upside down", "upside_down.ply", of(21, lambda X, T: (X * [1, -1, -1], T)), "ok",
          "^$", "alignment does not depend on the pose of the file", "nothing to do"),
    Fault("a part is cut off", "part.ply",
          of(30, lambda X, T: (X, T[(X[T, 2] < np.quantile(X[:, 2], 0.7)).all(axis=1)])),
          "flagged",
          r"boundary loops have a length of .* those of the others 0: is a part missing",
          "flagged in collections of five shapes or more, if its holes are much longer",
          "complete the scan, or leave it out", where="warning"),
    Fault("shape stretched by 3", "stretched.ply", of(31, lambda X, T: (X * [3, 1, 1], T)),
          "flagged", "outlier: .* robust deviations from the median; .* stretched",
          "warning about its form in collections of five or more; flagged if far from all others",
          "look at it; leave it out if it does not belong", where="warning"),
    Fault("another kind of shape", "rod.ply", rod, "flagged",
          "outlier: .* robust deviations from the median; is it another kind of shape", "the same",
          "leave it out", where="warning"),
    Fault("the same scan under two names", "same_as_packed.obj",
          of(3, lambda X, T: (np.round(X[::-1], 3) + 500, len(X) - 1 - T[::-1])), "flagged",
          "the same surface as packed; remove one of them",
          "flagged: detected by size, moments and volume, in any vertex order, pose and format",
          "leave one of them out", where="warning"),
    Fault("coordinates rounded", "rounded.ply", of(32, lambda X, T: (np.round(X / 4) * 4, T)), "ok",
          r"coordinates are rounded to 0\.[0-9]+ of an edge",
          "warning, if those of the others are not", "export it with more digits", where="warning"),
    Fault("inches among centimetres", "inches.ply", of(33, lambda X, T: (2.54 * X, T)), "flagged",
          r"2\.[45][0-9]* times the size of the others, near 2.54",
          "flagged in collections of five shapes or more; size is kept", "scale the file",
          where="warning"),
    Fault("coordinates offset by 1e6", "far.obj", far, "ok", "^$", "the same as centred",
          "nothing to do"),
    Fault("scale 1e-9", "tiny.obj", of(23, lambda X, T: (X * 1e-9, T)), "flagged",
          "1e-09 times the size of the others|e-10 times the size of the others",
          "same result as scaled, in the units of the input; warning of another unit",
          "scale the file", where="warning"),
    Fault("scale 1e9", "huge.obj", of(24, lambda X, T: (X * 1e9, T)), "flagged",
          r"e\+0?[89] times the size of the others",
          "same result as scaled, in the units of the input; warning of another unit",
          "scale the file", where="warning"),
    Fault("coordinates over 1e15", "giant.obj", of(30, lambda X, T: (X * 1e37, T)), "excluded",
          r"coordinates of at most 1e\+15 needed, found",
          "excluded, because their squares overflow", "scale the file"),
    Fault("an extent under 1e-15", "denormal.obj", of(31, lambda X, T: (X * 1e-300, T)), "excluded",
          "an extent of at least 1e-15 needed, found",
          "excluded, because its square underflows", "scale the file"),
    Fault("an offset that exceeds the precision", "lost.ply", of(32, lambda X, T: (X + 1e8, T)),
          "excluded", "lost in rounding: the extent is .* float32",
          "excluded: from 1e5 times the extent in float32 files, 1e11 times in float64",
          "subtract the offset before the file is written"),
    Fault("fewer vertices than the target resolution", "few.ply", of((25, 80)), "ok", "",
          "used as it is; the report says so", "nothing"),
    Fault("spaces and letters outside ASCII in a path", "Schädel der Maus 脳.ply", of(26), "ok",
          "^$", "works; the name is made of ASCII letters", "nothing to do",
          name="Schadel_der_Maus_u8133"),
    Fault("two files with one stem", "left/one.ply", of(27), "ok", "^$", "named by their folders",
          "nothing", name="left_one"),
    Fault("two files with one stem", "right/one.ply", of(28), "ok", "^$", "named by their folders",
          "nothing", name="right_one"),
    Fault("HTML in a shape's name", "<img src=x onerror=alert(1)>.ply", of(29), "ok", "^$",
          "escaped wherever it is shown", "rename the file", name="_img_src_x_onerror_alert_1__"),
    Fault("pickle in an NPZ", "pickle.npz", pickle, "excluded", "pickle",
          "excluded, never executed", "save plain arrays"),
    Fault("label files next to the surfaces", "some.label.gii", label, "",
          "some.label.gii is not a mesh .a GIFTI file without points. and was skipped",
          "skipped with a remark; no shape is lost", "nothing to do", where="remarks"),
]
# fmt: on
GOOD = [f"good_{i}" for i in range(10)]


def make(folder):
    """All faults and ten good shapes."""
    folder.mkdir(parents=True, exist_ok=True)
    for one in FAULTS:
        one.make(folder / one.file)
    for i, name in enumerate(GOOD):
        write_mesh(folder / f"{name}.ply", *shape(100 + i))
    return folder
