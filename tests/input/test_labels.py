"""Surfaces from label volumes: where they lie, what they enclose, and what is refused."""

import gzip
import time

import numpy as np
import pytest
from paths import DATA
from small import OPTIONS

import s4a
from s4a import cli
from s4a.geometry.mesh import as_arrays
from s4a.input.labels import check_label, read_volume
from s4a.options import Options, with_options

pytest.importorskip("skimage")
nibabel = pytest.importorskip("nibabel")
HIPPOCAMPI = DATA / "hippocampi_msd"
AFFINE = np.array([[-1.5, 0, 0, 40], [0, 1.2, 0.3, -50], [0, -0.2, 2, 7], [0, 0, 0, 1.0]])


def ball(n=30, radius=9.0, middle=None):
    """Voxels (n, n, n) of a ball: whether inside, and its middle."""
    middle = np.full(3, (n - 1) / 2) if middle is None else np.asarray(middle, float)
    return np.linalg.norm(np.indices((n, n, n)).T - middle, axis=-1).T < radius, middle


def write(path, values, affine=AFFINE, kind=None):
    kind = kind or nibabel.Nifti1Image
    kind(np.asarray(values), affine).to_filename(path)
    return path


def enclosed(X, T):
    a, b, c = X[T[:, 0]], X[T[:, 1]], X[T[:, 2]]
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.mgz", "a.mgh"])
def test_a_ball_lies_where_its_affine_puts_it_and_keeps_its_volume(tmp_path, name):
    inside, middle = ball(middle=[13, 15, 14])
    kind = nibabel.MGHImage if ".mg" in name else nibabel.Nifti1Image
    path = write(tmp_path / name, 17 * inside.astype(np.uint8), kind=kind)
    X, T, attrs = read_volume(path, 17)
    position = AFFINE[:3, :3] @ middle + AFFINE[:3, 3]
    np.testing.assert_allclose((X.max(0) + X.min(0)) / 2, position, atol=0.1)
    voxels = inside.sum() * abs(np.linalg.det(AFFINE[:3, :3]))
    assert enclosed(X - position, T) == pytest.approx(voxels, rel=0.01), "positive: outwards"
    assert (attrs["unit"], attrs["coordinate_system"]) == ("mm", "RAS")


def test_smoothing_takes_the_steps_of_the_voxels_and_does_not_shrink(tmp_path):
    inside, middle = ball()
    path = write(tmp_path / "a.nii", inside.astype(np.uint8), np.eye(4))
    (steps, T, _), (smooth, _, _) = (read_volume(path, 1, iterations=n) for n in (0, 20))
    rough, fine = (np.linalg.norm(X - middle, axis=1) for X in (steps, smooth))
    assert fine.std() < 0.5 * rough.std()
    assert fine.mean() == pytest.approx(rough.mean(), rel=0.005)
    assert enclosed(smooth - middle, T) == pytest.approx(inside.sum(), rel=0.006)


def test_affine_maps_of_either_orientation_give_outward_triangles(tmp_path):
    inside, middle = ball()
    for sign in (1, -1):
        affine = np.diag([sign, 1, 1, 1.0])
        X, T, _ = read_volume(write(tmp_path / "a.nii", inside.astype(np.uint8), affine), "all")
        assert enclosed(X - affine[:3, :3] @ middle, T) > 0


def test_several_labels_are_one_structure(tmp_path):
    inside, _ = ball()
    halves = inside.astype(np.uint8)
    halves[15:] *= 2
    whole = write(tmp_path / "whole.nii", inside.astype(np.uint8))
    path = write(tmp_path / "halves.nii", halves)
    X, T, _ = read_volume(whole, 1)
    for label in ([1, 2], "1,2", "all"):
        Y, S, _ = read_volume(path, label)
        np.testing.assert_array_equal(X, Y)
        np.testing.assert_array_equal(T, S)
    assert len(read_volume(path, 2)[0]) < len(X)


def test_a_structure_at_the_border_is_closed_with_a_note(tmp_path):
    inside, _ = ball(middle=[3, 15, 15])
    shape = s4a.read_shape(write(tmp_path / "a.nii", inside.astype(np.uint8)), label=1)
    assert shape.attrs["holes"] == 0
    assert "reaches the border of the volume, and was closed there" in shape.attrs["reason"]
    whole = s4a.read_shape(write(tmp_path / "b.nii", ball()[0].astype(np.uint8)), label=1)
    assert "border" not in whole.attrs["reason"]


def test_the_largest_of_several_components_is_kept_and_the_others_reported(tmp_path):
    values = ball()[0].astype(np.uint8)
    values[1:4, 1:4, 1:4] = 1
    path = write(tmp_path / "a.nii", values)
    shape = s4a.read_shape(path, label=1)
    assert (shape.attrs["components"], shape.attrs["dropped_components"]) == (2, 1)
    assert s4a.read_shape(path, label=1, components="all").attrs["dropped_components"] == 0


def test_units_other_than_millimetres_are_brought_to_them(tmp_path):
    inside, _ = ball()
    image = nibabel.Nifti1Image(inside.astype(np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1]))
    image.header.set_xyzt_units("meter")
    image.to_filename(tmp_path / "a.nii")
    X, _, attrs = read_volume(tmp_path / "a.nii", 1)
    np.testing.assert_allclose(np.ptp(X, axis=0), 18, atol=0.5)
    assert attrs["unit"] == "mm"


def test_a_volume_that_does_not_say_how_it_lies_is_named(tmp_path):
    image = nibabel.Nifti1Image(ball()[0].astype(np.uint8), None)
    image.to_filename(tmp_path / "a.nii")
    _, _, attrs = read_volume(tmp_path / "a.nii", 1)
    assert "left and right may be exchanged" in attrs["note"]
    assert "coordinate_system" not in attrs
    data = bytearray((tmp_path / "a.nii").read_bytes())
    data[80:84] = bytes(4)  # the size of the voxels in x
    (tmp_path / "a.nii").write_bytes(data)
    with pytest.raises(ValueError, match="sizes of voxels needed, found 0 in pixdim"):
        read_volume(tmp_path / "a.nii", 1)


def test_a_volume_with_two_places_is_named(tmp_path):
    image = nibabel.Nifti1Image(ball()[0].astype(np.uint8), np.diag([-2, 2, 2, 1]))
    for qform, code, note in (
        (np.diag([-2, 2, 2, 1]), 2, False),
        (np.diag([2, 2, 2, 1]), 2, True),
        (np.diag([2, 2, 2, 1]), 4, False),  # of a template
    ):
        image.set_sform(np.diag([-2, 2, 2, 1]), code)
        image.set_qform(qform, 1)
        image.to_filename(tmp_path / "a.nii")
        X, _, attrs = read_volume(tmp_path / "a.nii", 1)
        assert ("sform and qform place the volume up to" in attrs.get("note", "")) == note
        assert X[:, 0].max() < 0


@pytest.mark.parametrize(
    "values, label, why",
    [
        (np.full((4, 4, 4), 3, np.int16), 17, "label 17 expected, found 3"),
        (np.arange(64).reshape(4, 4, 4), 99, r"label 99 expected, found 1, 2, .*, 30 \.\.\."),
        (np.zeros((4, 4, 4), np.uint8), 17, ".*found 0 in every voxel"),
        (np.zeros((4, 4, 4), np.uint8), "all", ".*found 0 in every voxel"),
        (np.full((4, 4, 4), 0.25, np.float32), 1, "integers expected"),
        (
            np.ones((4, 4, 4, 2), np.uint8),
            1,
            r"a volume of three dimensions expected, found \(4, 4, 4, 2\)",
        ),
    ],
)
def test_what_is_no_such_volume_is_refused(tmp_path, values, label, why):
    values = values.astype(np.int32) if values.dtype == np.int64 else values
    path = write(tmp_path / "a.nii.gz", values)
    with pytest.raises(ValueError, match=rf"a\.nii\.gz cannot be read as a label volume: {why}"):
        read_volume(path, label)


def nrrd(path, values, affine, encoding="gzip", **changed):
    """Write what 3D Slicer writes, in LPS; `changed` replaces fields, or drops them if None."""
    lps = np.diag([-1, -1, 1, 1]) @ affine
    fields = {
        "type": "unsigned char",
        "dimension": "3",
        "space": "left-posterior-superior",
        "sizes": " ".join(map(str, values.shape)),
        "space directions": " ".join("({},{},{})".format(*axis) for axis in lps[:3, :3].T),
        "kinds": "domain domain domain",
        "encoding": encoding,
        "space origin": "({},{},{})".format(*lps[:3, 3]),
    } | changed
    head = "".join(f"{name}: {text}\n" for name, text in fields.items() if text is not None)
    body = values.astype(np.uint8).tobytes(order="F")
    body = gzip.compress(body) if encoding == "gzip" else body
    path.write_bytes(f"NRRD0004\n# a comment\n{head}Segment0_ID:=spleen\n\n".encode() + body)
    return path


def test_other_files_of_the_same_volume_give_the_same_surface(tmp_path):
    values = 17 * ball(middle=[13, 15, 14])[0].astype(np.uint8)
    X, T, _ = read_volume(write(tmp_path / "a.nii", values), 17)
    scaled = nibabel.Nifti1Image(values + 0.0, AFFINE)
    scaled.set_data_dtype(np.int16)  # with a slope, as nibabel stores floats
    scaled.to_filename(tmp_path / "scaled.nii.gz")
    files = {
        "two.nii": write(tmp_path / "two.nii", values, kind=nibabel.Nifti2Image),
        "a.seg.nrrd": nrrd(tmp_path / "a.seg.nrrd", values, AFFINE),
        "raw.nrrd": nrrd(tmp_path / "raw.nrrd", values, AFFINE, "raw", type="uint8_t"),
        "float.nii": write(tmp_path / "float.nii", values.astype(np.float32)),
        "scaled.nii.gz": tmp_path / "scaled.nii.gz",
    }
    for name, path in files.items():
        Y, S, attrs = read_volume(path, 17)
        np.testing.assert_allclose(Y, X, atol=1e-4, err_msg=name)
        np.testing.assert_array_equal(S, T)
        assert attrs["coordinate_system"] == "RAS"
        assert ("were rounded" in attrs.get("note", "")) == (name == "scaled.nii.gz")
    small = AFFINE * np.array([[0.1], [0.1], [0.1], [1]])
    changed = {"space units": '"cm" "cm" "cm"', "byte skip": "0", "endian": "Big"}
    Y = read_volume(nrrd(tmp_path / "cm.nrrd", values, small, **changed), 17)[0]
    np.testing.assert_allclose(Y, X, atol=1e-4)
    _, _, attrs = read_volume(nrrd(tmp_path / "b.nrrd", values, AFFINE, space=None), 17)
    assert "no orientation" in attrs["note"]
    nibabel.save(nibabel.MGHImage(values, AFFINE), tmp_path / "a.mgh")
    data = (tmp_path / "a.mgh").read_bytes()
    (tmp_path / "a.mgh").write_bytes(data[:28] + b"\0\0" + data[30:])  # goodRASFlag
    assert read_volume(tmp_path / "a.mgh", 17)[2]["coordinate_system"] == "RAS, origin unknown"


@pytest.mark.parametrize(
    "changed, why",
    [
        ({"sizes": "2 30 30 30"}, "three sizes expected, found .* 2 30 30 30: export a label map"),
        ({"sizes": "30 30 300"}, "bytes of voxels"),
        ({"type": "block"}, "numbers, .*, found block"),
        ({"data file": "a.raw"}, "voxels in the same file, expected"),
        ({"byte skip": "-1"}, "voxels in the same file, expected"),
        ({"space units": '"furlong"'}, "one unit of um, mm, .*found .*furlong"),
        ({"encoding": "bzip2"}, "raw or gzip, .*, found .*bzip2"),
    ],
)
def test_an_nrrd_file_that_is_no_label_volume_is_refused(tmp_path, changed, why):
    with pytest.raises(ValueError, match=rf"a\.nrrd.*{why}"):
        read_volume(nrrd(tmp_path / "a.nrrd", ball()[0], AFFINE, **changed), 1)


def test_mixtures_and_probabilities_are_no_labels(tmp_path):
    inside = ball()[0].astype(np.float32)
    for rest in (0.5, 0.002, np.nan):
        inside[3, 3, 3] = 1 + rest
        with pytest.raises(ValueError, match="integers expected, found"):
            read_volume(write(tmp_path / "a.nii", inside), 1)


def test_damaged_volumes_are_refused(tmp_path):
    path = write(tmp_path / "a.nii", ball()[0].astype(np.uint8))
    data = path.read_bytes()
    huge = bytearray(data)
    huge[42:48] = np.array([30000, 30000, 30000], "<i2").tobytes()
    flat = bytearray(data)
    flat[280:328] = bytes(48)  # the rows of the affine map
    for damaged, why in (
        (data[:500], "bytes of voxels"),
        (huge, "27000000000000 bytes of voxels"),
        (flat, "an invertible affine map"),
        (b"OFF 3 1 0" * 100, "NIfTI, MGH or NRRD expected"),
        (gzip.compress(data)[:-200], "truncated|damaged|bytes of voxels"),
    ):
        path.write_bytes(bytes(damaged))
        with pytest.raises(ValueError, match=why):
            read_volume(path, 1)


@pytest.mark.parametrize("label", [0, "0", "", "1,", [], True, 1.5, [1.5], "left", (0, 1)])
def test_labels_that_are_none_are_refused(label):
    with pytest.raises(ValueError, match=r"label needs a number other than 0"):
        check_label(label)


def test_without_scikit_image_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("s4a.options.find_spec", lambda name: None)
    assert Options(label=None).label is None
    with pytest.raises(ValueError, match=r"pip install 's4a\[labels\]'"):
        Options(label=17)


def test_options_keep_their_labels_in_the_report():
    for label in (17, "1,2", "all", None, [2, 1]):
        options = Options(label=label)
        report = s4a.read_shapes({"a": as_arrays(s4a.synthetic.sphere(30))})
        report["report"].attrs = with_options({}, vars(options))
        assert Options.from_report(report) == options
    assert Options(label=[2, 1]).label == "1,2"


def test_a_volume_without_a_label_says_how_to_read_it(tmp_path):
    path = write(tmp_path / "a.nii.gz", ball()[0].astype(np.uint8))
    with pytest.raises(
        ValueError, match=r"found a volume \(NIfTI\); give a label \(label=17, --label 17\)"
    ):
        s4a.read_mesh(path)


@pytest.fixture(scope="module")
def volumes(tmp_path_factory):
    """Four ellipsoids of label 17 in volumes, with a mesh and a text file in the folder."""
    folder = tmp_path_factory.mktemp("volumes")
    for i in range(5):
        axes = np.array([10, 7 + i / 2, 6 - i / 3])
        grid = np.indices((28, 28, 28)).T - 13.5 + [0, 0, i / 7]
        inside = (((grid / axes) ** 2).sum(-1) < 1).T
        write(folder / f"scan_{i}.nii.gz", 17 * inside.astype(np.uint8))
    s4a.write_mesh(folder / "mesh.ply", *as_arrays(s4a.synthetic.sphere(60)))
    (folder / "notes.txt").write_text("17: hippocampus")
    return folder


def test_of_a_folder_the_volumes_are_read_or_the_meshes(volumes):
    shapes = s4a.read_labels(volumes, label=17)
    assert list(shapes["original"]) == [f"scan_{i}" for i in range(5)]
    assert list(s4a.read_shapes(volumes)["original"]) == ["mesh"]
    by_glob = s4a.read_labels(str(volumes / "*"), label=17)
    assert "notes.txt is not a label volume (a .txt file)" in by_glob["report"].attrs["remarks"]
    with pytest.raises(ValueError, match="no label volume of 5 files matching 'nothing'"):
        s4a.read_labels(volumes, label=17, pattern="nothing")
    with pytest.raises(
        ValueError, match=r"no label volume \(.nii, .mgz, .mgh, .nrrd\).*a .ply file"
    ):
        s4a.read_labels(str(volumes / "*.ply"), label=17)
    with pytest.raises(ValueError, match="label 4 expected, found 17"):
        s4a.read_labels(volumes, label=4)


def test_one_command_leads_from_volumes_to_modes_and_resumes_and_inserts(volumes, tmp_path, capsys):
    flags = [word for k, v in OPTIONS.items() for word in (f"--{k.replace('_', '-')}", str(v))]
    out = tmp_path / "study"
    command = ["run", str(volumes), "--label", "17", "--out", str(out), "--pattern", "*_[0-3]"]
    assert cli.main([*command, *flags]) == 0
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*.nc")}
    assert cli.main([*command, *flags]) == 0
    kept = [path for path, time in files.items() if path.stat().st_mtime_ns == time]
    assert len([path for path in kept if path.parent.name == "original"]) == 4, "resumed"
    assert cli.main(["verify", str(out)]) == 0
    study = s4a.open_study(out)
    assert study["pca"].sizes["component"] == 3
    assert Options.from_report(study).label == 17
    new = s4a.insert(study, volumes / "scan_4.nii.gz")
    assert new["pca"]["score"].sizes == {"shape": 1, "component": 3}
    assert "label 17" in capsys.readouterr().out or new["original/scan_4"].attrs["label"] == "17"
    mesh = as_arrays(study["original/scan_1"].to_dataset())
    study.close()
    s4a.write_mesh(tmp_path / "a mesh.ply", *mesh)  # meshes go into a study of volumes, too
    into = [str(out), str(tmp_path / "a mesh.ply"), "--out", str(tmp_path / "new")]
    assert cli.main(["insert", *into]) == 2  # a PLY file does not say its coordinate system
    assert cli.main(["insert", *into, "--coordinate-system", "RAS", "--unit", "mm"]) == 0
    x = mesh[0][:, 0]
    np.save(tmp_path / "labels.npy", (x > x.mean()).astype(int))
    labels = ["--labels", str(tmp_path / "labels.npy"), "--out", str(tmp_path / "carried")]
    labels += ["--coordinate-system", "RAS", "--unit", "mm"]
    assert cli.main(["transfer", str(tmp_path / "a mesh.ply"), str(out), *labels]) == 0
    carried = np.load(tmp_path / "carried" / "scan_2.labels.npy")
    assert len(carried) == len(read_volume(volumes / "scan_2.nii.gz", 17)[0])


def test_another_label_is_another_file_of_the_study(volumes, tmp_path):
    halves = tmp_path / "halves"
    halves.mkdir()
    for i in range(2):
        image = nibabel.load(volumes / f"scan_{i}.nii.gz")
        values = np.asarray(image.dataobj).copy()
        values[:14][values[:14] > 0] = 18
        write(halves / f"scan_{i}.nii.gz", values)
    first = s4a.analyse(halves, store=tmp_path / "study", label=17, **OPTIONS)
    n = first["original/scan_0"].sizes["vertex"]
    first.close()
    whole = s4a.analyse(halves, store=tmp_path / "study", label=[17, 18], **OPTIONS)
    assert whole["original/scan_0"].sizes["vertex"] > n
    whole.close()


@pytest.mark.skipif(not HIPPOCAMPI.is_dir(), reason="needs ../shared/data/hippocampi_msd")
def test_real_hippocampi_keep_their_volume_and_are_one_closed_surface_each():
    files = sorted(HIPPOCAMPI.glob("*.nii.gz"))[:6]
    shapes = s4a.read_labels(files, label=[1, 2], compare=False)
    assert len(shapes["original"]) == 6
    for file in files:
        X, T = as_arrays(shapes["original"][file.name.split(".")[0]].to_dataset())
        image = nibabel.load(file)
        voxels = (np.asarray(image.dataobj) > 0).sum() * abs(np.linalg.det(image.affine))
        assert enclosed(X - X.mean(0), T) == pytest.approx(voxels, rel=0.04)


def test_the_panel_of_a_run_counts_volumes(volumes, tmp_path):
    from s4a.widgets.progress import Progress

    panel = Progress(volumes, tmp_path / "study", label=17, **OPTIONS)
    end = time.monotonic() + 60
    while panel.bars["read and clean"].max != 5:
        assert time.monotonic() < end
        time.sleep(0.05)
        panel.update()
    panel.stop.click()
    panel.process.join(20)
    panel.close()
