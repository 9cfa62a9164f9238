"""A bad file, line or name costs one frame, which is named; nothing shifts, and nothing outside the folder is read."""

import json
import os
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from conformodal.cli.main import app
from conformodal.datasets import (
    DatasetError,
    DatasetWarning,
    ImageError,
    Layout,
    PixelNoise,
    SplitError,
    check_sequence,
    make_split,
    read_sequence,
)
from conformodal.datasets.streams.opening import open_stream
from conformodal.datasets.streams.stored import SequenceStream
from conformodal.poses import PoseError, Trajectory, associate, matrix_from_quat_wxyz, read_euroc, read_kitti, read_tum
from conformodal.running.paths import METHODS
from conformodal.running.results.runs import write_metrics
from conformodal.running.results.writer import ResultsWriter

sys.path.insert(0, str(Path(__file__).parents[1] / "datasets"))
from test_layouts import WRITERS, N

NAN = float("nan")
LISTS = {Layout.TUM: "rgb.txt", Layout.EUROC: "mav0/cam0/data.csv"}


def invoke(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def expect(folder, layout, before, lost, match, *, always=False):
    """One frame is lost to training and named; the others are as before. `always`: to every reading."""
    kept = [i for i in range(N) if i not in lost]
    with pytest.warns(DatasetWarning, match=match):
        sequence = read_sequence(folder, layout)
    assert sequence.image_paths == tuple(before.image_paths[i] for i in kept)
    np.testing.assert_allclose(sequence.timestamps_s, before.timestamps_s[kept])
    np.testing.assert_allclose(sequence.require_truth().poses_se3, before.truth.poses_se3[kept], atol=1e-9)
    assert sequence.camera == before.camera
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)
        everything = read_sequence(folder, layout, require_poses=False)
    assert everything.image_paths == (sequence.image_paths if always else before.image_paths)
    result = invoke("data", "check", folder, "--format", layout)
    assert result.exit_code == 1, result.output
    assert "nothing is wrong" not in result.output


# Damage to the file of one image


def empty(path):
    path.write_bytes(b"")


def cut(path):
    path.write_bytes(path.read_bytes()[:60])


def a_folder(path):
    path.unlink()
    path.mkdir()


def broken_link(path):
    path.unlink()
    path.symlink_to("nowhere.png")


def link_to_itself(path):
    path.unlink()
    path.symlink_to(path.name)


def a_pipe(path):
    path.unlink()
    os.mkfifo(path)


def a_device(path):
    path.unlink()
    path.symlink_to("/dev/zero")


def text(path):
    path.write_text("404: Not Found")


IMAGES = {f.__name__: f for f in (empty, cut, a_folder, broken_link, a_pipe, text)}


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("damage", IMAGES)
def test_a_bad_image_costs_its_frame(tmp_path, layout, damage):
    folder = WRITERS[layout](tmp_path)
    before = read_sequence(folder)
    place = (list(WRITERS).index(layout) + list(IMAGES).index(damage)) % 2 * 3  # the first, or one in the middle
    IMAGES[damage](before.image_paths[place])
    expect(folder, layout, before, [place], before.image_paths[place].name)
    frames = list(SequenceStream(read_sequence(folder, require_poses=False)))
    assert [frame.image is None for frame in frames] == [i == place for i in range(N)]


@pytest.mark.parametrize("damage", [link_to_itself, a_device])
def test_links_to_what_is_no_image(tmp_path, damage):
    folder = WRITERS[Layout.IMAGES](tmp_path)
    before = read_sequence(folder)
    damage(before.image_paths[0])
    expect(folder, Layout.IMAGES, before, [0], before.image_paths[0].name)


@pytest.mark.parametrize("layout", WRITERS)
def test_a_data_set_without_one_sound_image_is_refused(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    for path in read_sequence(folder).image_paths:
        path.write_bytes(b"")
    with pytest.raises(ImageError, match="cannot be decoded"):
        read_sequence(folder)


JUNK = ["._{name}", ".DS_Store", "Thumbs.db", "desktop.ini", ".{name}.swp", "{name}.part", ".hidden.png"]


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("junk", JUNK)
def test_what_systems_leave_behind_is_no_frame(tmp_path, layout, junk):
    folder = WRITERS[layout](tmp_path)
    before = read_sequence(folder)
    for path in {p.parent for p in tmp_path.rglob("*") if p.is_file()}:
        (path / junk.format(name=before.image_paths[0].name)).write_bytes(b"\0\5\x16\7")
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        after = read_sequence(folder)
    assert after.image_paths == before.image_paths
    assert after.notes == ()
    np.testing.assert_array_equal(after.truth.positions_xyz, before.truth.positions_xyz)


# Damage to one pose


def pose_file(layout, root):
    names = {Layout.KITTI: "poses/07.txt", Layout.RGBD_SCENES: "pc/02.pose", Layout.IMAGES: "poses.tum"}
    names |= {Layout.EUROC: "mav0/state_groundtruth_estimate0/data.csv"}
    return root / names[layout] if layout in names else next(root.rglob("groundtruth.txt"))


def spoil_line(layout, root, change):
    """Change the line of frame 2's pose."""
    path = pose_file(layout, root)
    lines = path.read_text().splitlines()
    at = [k for k, line in enumerate(lines) if not line.startswith("#")][2]
    lines[at] = change(lines[at])
    path.write_text("\n".join(lines) + "\n")


def field(k, value):
    def change(line):
        comma = "," in line
        fields = line.split("," if comma else None)
        fields[k] = value
        return ("," if comma else " ").join(fields)

    return change


def no_direction(layout):
    places = {Layout.RGBD_SCENES: slice(0, 4)}

    def change(line):
        comma = "," in line
        fields = line.split("," if comma else None)
        place = places.get(layout, slice(4, 8))
        fields[place] = ["0"] * 4
        return ("," if comma else " ").join(fields)

    return change


QUATERNIONS = (Layout.TUM, Layout.IMAGES, Layout.EUROC, Layout.RGBD_SCENES)
POSES = {
    "NaN": (field(3, "nan"), (*QUATERNIONS, Layout.KITTI)),
    "infinity": (field(5, "-inf"), (*QUATERNIONS, Layout.KITTI)),
    "more than a number can be": (field(4, "1e400"), (*QUATERNIONS, Layout.KITTI)),
    "an underscore": (field(3, "1_0"), (*QUATERNIONS, Layout.KITTI)),
    "digits of another script": (field(3, "\u0661"), (*QUATERNIONS, Layout.KITTI)),
    "a word": (field(3, "lost"), (*QUATERNIONS, Layout.KITTI)),
    "a decimal comma": (field(3, "1;5"), (*QUATERNIONS, Layout.KITTI)),
    "a line that is cut": (lambda line: line[: len(line) // 3], (*QUATERNIONS, Layout.KITTI)),
    "a NUL": (lambda line: line[:9] + "\0" + line[9:], (*QUATERNIONS, Layout.KITTI)),
    "a very long line": (lambda line: line + " 1" * 100_000 + "x", (Layout.TUM, Layout.IMAGES, Layout.KITTI)),
    "no direction": (None, QUATERNIONS),
    "far away": (field(3, "1e200"), (Layout.TUM, Layout.IMAGES, Layout.EUROC, Layout.KITTI)),
    "no rotation": (field(0, "2.5"), (Layout.KITTI,)),
    "a mirror": (
        lambda line: " ".join(f"{-float(v)}" if k % 4 == 1 else v for k, v in enumerate(line.split())),
        (Layout.KITTI,),
    ),
}


@pytest.mark.parametrize(("what", "layout"), [(w, a) for w, (_, layouts) in POSES.items() for a in layouts])
def test_a_bad_line_of_poses_costs_its_frame(tmp_path, what, layout):
    folder = WRITERS[layout](tmp_path)
    before = read_sequence(folder)
    spoil_line(layout, tmp_path, POSES[what][0] or no_direction(layout))
    expect(folder, layout, before, [2], before.image_paths[2].name)


POSE_FILES = {
    "missing": None,
    "empty": b"",
    "half": b"1 0 0 0\n0 1 0 0\n",
    "NaN": b"nan 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
    "lost tracking": b"-inf -inf -inf -inf\n" * 4,
    "zeros": b"0 0 0 0\n" * 4,
    "no rotation": b"2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
    "a mirror": b"-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
    "a last row": b"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n",
    "transposed": b"1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n",
    "far away": b"1 0 0 1e300\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
    "bytes": b"\xff\xfe\x001\x00",
    "an underscore": b"1_0 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
}


@pytest.mark.parametrize("what", POSE_FILES)
@pytest.mark.parametrize("place", [0, 3])
def test_a_bad_7_scenes_pose_costs_its_frame(tmp_path, what, place):
    folder = WRITERS[Layout.SEVENSCENES](tmp_path)
    before = read_sequence(folder)
    path = tmp_path / "seq-01" / f"frame-{place:06d}.pose.txt"
    path.unlink()
    if POSE_FILES[what] is not None:
        path.write_bytes(POSE_FILES[what])
    expect(folder, Layout.SEVENSCENES, before, [place], rf"frame-{place:06d}\.color\.png: .*frame-{place:06d}\.pose")
    some = read_sequence(folder, require_poses=False)
    assert some.truth is None
    assert len(some.known_poses) == N - 1


@pytest.mark.parametrize("damage", [a_folder, broken_link, a_pipe])
def test_a_7_scenes_pose_that_is_no_file_costs_its_frame(tmp_path, damage):
    folder = WRITERS[Layout.SEVENSCENES](tmp_path)
    before = read_sequence(folder)
    damage(tmp_path / "seq-01" / "frame-000001.pose.txt")
    expect(folder, Layout.SEVENSCENES, before, [1], "frame-000001")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda m: m[0].__setitem__(0, NAN), "NaN"),
        (lambda m: m[0].__setitem__(3, float("inf")), "NaN or infinity|away"),
        (lambda m: m[1].__setitem__(3, 1e250), "away"),
        (lambda m: m[0].__setitem__(0, 7.0), "no rotation"),
        (lambda m: [row.__setitem__(0, -row[0]) for row in m], "mirror"),
        (lambda m: m[3].__setitem__(3, 2.0), "last row"),
    ],
)
def test_a_bad_nerf_pose_costs_its_frame(tmp_path, change, match):
    folder = WRITERS[Layout.NERF](tmp_path)
    before = read_sequence(folder)
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    change(next(f for f in content["frames"] if "0002" in f["file_path"])["transform_matrix"])
    path.write_text(json.dumps(content))
    expect(folder, Layout.NERF, before, [2], rf"0002\.png.*{match}")


@pytest.mark.parametrize(
    "numbers", ["nan 0 0 1 0 0 0", "0 0 0 0 1 2 3", "1 0 0 0 inf 0 0", "1 0 0 0 1e200 0 0", "1e400 0 0 0 0 0 0"]
)
def test_a_bad_colmap_pose_costs_its_frame(tmp_path, numbers):
    folder = WRITERS[Layout.COLMAP](tmp_path)
    before = read_sequence(folder)
    path = next(tmp_path.rglob("images.txt"))
    lines = [f"9 {numbers} 3 0002.png" if x.endswith("0002.png") else x for x in path.read_text().splitlines()]
    path.write_text("\n".join(lines) + "\n")
    expect(folder, Layout.COLMAP, before, [2], r"0002\.png")


def test_two_poses_for_one_time_are_no_pose(tmp_path):
    folder = WRITERS[Layout.TUM](tmp_path)
    before = read_sequence(folder)
    path = pose_file(Layout.TUM, tmp_path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, field(1, "7")(lines[3])]) + "\n")
    expect(folder, Layout.TUM, before, [2], "2.png: no pose within")
    assert "two poses for time" in read_sequence(folder).notes[0].where


# Damage to one time

TIMES = {
    "NaN": "nan",
    "infinite": "inf",
    "overflowing": "1e400",
    "twice": lambda times: times[1],
    "decreasing": lambda times: times[0],
    "far ahead": lambda times: f"{9 * float(times[2])}",
}


@pytest.mark.parametrize("what", TIMES)
@pytest.mark.parametrize("layout", [Layout.TUM, Layout.KITTI, Layout.IMAGES, Layout.EUROC])
def test_a_bad_time_costs_its_frame(tmp_path, what, layout):
    folder = WRITERS[layout](tmp_path)
    if layout is Layout.IMAGES:
        for i, path in enumerate(sorted(folder.glob("*.png"))):
            path.rename(folder / f"{i}.png")
        (folder / "times.txt").write_text("\n".join(f"{100 + 0.1 * i}" for i in range(N)))
    before = read_sequence(folder)
    path = folder / LISTS.get(layout, "times.txt")
    lines = path.read_text().splitlines()
    at = [k for k, line in enumerate(lines) if not line.startswith("#")]
    separator = "," if layout is Layout.EUROC else " "
    times = [lines[k].split(separator)[0] for k in at]
    new = TIMES[what](times) if callable(TIMES[what]) else TIMES[what]
    if layout is Layout.EUROC and what == "far ahead":
        new = str(9 * int(times[2]))
    lines[at[2]] = separator.join([new, *lines[at[2]].split(separator)[1:]])
    path.write_text("\n".join(lines))
    match = path.name if layout is Layout.EUROC and not callable(TIMES[what]) else rf"{before.image_paths[2].name}|time"
    lost = [2]
    if what == "decreasing":  # frame 0 and 2 share a time; the later is told
        match = "goes back or occurs twice|left out, no pose"
    expect(folder, layout, before, lost, match, always=True)


def test_times_that_run_backwards_are_refused(tmp_path):
    folder = WRITERS[Layout.KITTI](tmp_path)
    (folder / "times.txt").write_text("5 4 3 2 1\n")
    with pytest.raises(DatasetError, match="timestamps must increase"):
        read_sequence(folder)


@pytest.mark.parametrize("rate", ["nan", "0", "-3", "inf", "1e400", "1e-300", "1e300", "30 30", "", "3_0", "\u0663"])
@pytest.mark.parametrize("layout", [Layout.SEVENSCENES, Layout.COLMAP, Layout.NERF])
def test_a_frame_rate_that_is_none_is_refused(tmp_path, layout, rate):
    folder = WRITERS[layout](tmp_path)
    (tmp_path / "frame-rate.txt").write_text(rate)
    with pytest.raises(DatasetError, match=r"frame-rate\.txt: (holds|cannot be read)"):
        read_sequence(folder)


# Lines and text


@pytest.mark.parametrize("layout", LISTS)
@pytest.mark.parametrize(
    "line", ["lost", "12", "x,y", "1\0 2", "now rgb/0.png", "1_0 rgb/0.png", "1_0,0.png", ",", "5,"]
)
def test_a_bad_line_of_images_is_left_out(tmp_path, layout, line):
    folder = WRITERS[layout](tmp_path)
    before = read_sequence(folder)
    path = folder / LISTS[layout]
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], line, *lines[3:]]))
    with pytest.warns(DatasetWarning, match=rf"{path.name}, line 4: expected"):
        after = read_sequence(folder)
    assert after.image_paths == before.image_paths
    np.testing.assert_array_equal(after.truth.positions_xyz, before.truth.positions_xyz)


def texts(root):
    return [
        p for p in root.rglob("*") if p.is_file() and p.suffix in (".txt", ".csv", ".yaml", ".json", ".pose", ".tum")
    ]


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize(
    "change",
    [
        lambda content: b"\xef\xbb\xbf" + content,
        lambda content: content.replace(b"\n", b"\r\n"),
        lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"),
        lambda content: content.replace(b"\n", b"\r"),
        lambda content: content.rstrip(b"\n"),
        lambda content: content.rstrip(b"\n") + b"\n\n\n",
    ],
    ids=["BOM", "CRLF", "BOM and CRLF", "CR", "no last newline", "blank lines at the end"],
)
def test_texts_of_other_systems_are_read_the_same(tmp_path, layout, change):
    folder = WRITERS[layout](tmp_path)
    before = read_sequence(folder)
    for path in texts(tmp_path):
        path.write_bytes(change(path.read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        after = read_sequence(folder)
    assert after.image_paths == before.image_paths
    assert after.camera == before.camera
    np.testing.assert_array_equal(after.timestamps_s, before.timestamps_s)
    np.testing.assert_array_equal(after.truth.positions_xyz, before.truth.positions_xyz)


TEXTS = [
    (layout, name)
    for layout, names in {
        Layout.SEVENSCENES: ("camera-intrinsics.txt", "frame-rate.txt"),
        Layout.RGBD_SCENES: ("02.pose",),
        Layout.KITTI: ("calib.txt", "times.txt", "07.txt"),
        Layout.TUM: ("rgb.txt", "groundtruth.txt", "camera-intrinsics.txt"),
        Layout.EUROC: ("sensor.yaml", "cam0/data.csv", "state_groundtruth_estimate0/data.csv"),
        Layout.COLMAP: ("cameras.txt", "images.txt", "frame-rate.txt"),
        Layout.NERF: ("transforms.json", "frame-rate.txt"),
        Layout.IMAGES: ("poses.tum", "camera-intrinsics.txt"),
    }.items()
    for name in names
]


@pytest.mark.parametrize(("layout", "name"), TEXTS)
@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe1\x002\x00", b"caf\xe9 1 2\n", bytes(300), b"\n\n\n", "folder", "pipe"]
)
def test_a_text_that_is_none_is_refused_by_name(tmp_path, layout, name, content):
    folder = WRITERS[layout](tmp_path)
    path = next(p for p in tmp_path.rglob("*") if str(p).endswith("/" + name))
    path.unlink()
    if content == "folder":
        path.mkdir()
    elif content == "pipe":
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DatasetWarning)
            sequence = read_sequence(folder, layout)
    except DatasetError as exc:
        assert Path(name).name in str(exc) or "no cameras.txt with images.txt" in str(exc)  # noqa: PT017
    else:  # what may be missing is missing where it is no file
        assert content in ("folder", "pipe")
        assert Path(name).name in ("times.txt", "frame-rate.txt")
        assert len(sequence) == N


# Names


def test_a_name_that_is_not_utf_8_costs_its_frame(tmp_path):
    folder = WRITERS[Layout.IMAGES](tmp_path)
    before = read_sequence(folder)
    for i, path in enumerate(before.image_paths):
        path.rename(os.fsdecode(os.fsencode(folder) + (b"/%d.png" % i if i != 2 else b"/2\xff.png")))
    np.savetxt(folder / "poses.txt", before.truth.poses_se3[:, :3].reshape(N, 12))
    (folder / "poses.tum").unlink()
    with pytest.warns(DatasetWarning, match="not UTF-8"):
        after = read_sequence(folder)
    np.testing.assert_allclose(after.truth.positions_xyz, np.delete(before.truth.positions_xyz, 2, axis=0), atol=1e-9)
    result = invoke("data", "check", folder)
    assert result.exit_code == 1, result.output
    assert r"2\xff.png: its name is not UTF-8" in result.output


def test_a_folder_with_such_a_name_is_refused(tmp_path):
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/\xff")
    os.mkdir(folder)
    WRITERS[Layout.IMAGES](Path(folder))
    with pytest.raises(DatasetError, match=r"\\xff: its name is not UTF-8"):
        read_sequence(folder)


@pytest.mark.parametrize("layout", [Layout.AUTO, *WRITERS])
@pytest.mark.parametrize("what", ["nowhere", "file", "empty"])
def test_what_is_no_data_set_is_refused(tmp_path, layout, what):
    path = tmp_path / "a"
    if what == "file":
        path.write_text("x")
    elif what == "empty":
        path.mkdir()
    with pytest.raises(DatasetError):
        read_sequence(path, layout)


def test_a_layout_that_is_none_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="layout must be one of"):
        read_sequence(tmp_path, "blender")


# Paths that leave the folder


def outside(how, folder, root):
    """A name that leads from a folder of images to another one beside the data set."""
    there = root.parent / f"{root.name}-other"
    there.mkdir()
    Image.new("RGB", (64, 48), (255, 0, 0)).save(there / "x.png")
    if how == "absolute":
        return str(there / "x.png")
    if how == "dots":
        return os.path.relpath(there / "x.png", folder)
    if how == "link":
        (folder / "link.png").symlink_to(there / "x.png")
        return "link.png"
    (folder / "linked").symlink_to(there)
    return "linked/x.png"


NAMED = {
    Layout.TUM: ("rgb.txt", "rgb/2.png", ""),
    Layout.EUROC: ("data.csv", "{name}", "mav0/cam0/data"),
    Layout.COLMAP: ("images.txt", "0002.png", "images"),
    Layout.NERF: ("transforms.json", "./images/0002", ""),
}


def naming_outside(tmp_path, layout, how):
    """A data set of which one image lies beside it, and the file that names it."""
    root = tmp_path / "set"
    root.mkdir()
    folder = WRITERS[layout](root)
    file, name, base = NAMED[layout]
    path = next(root.rglob(file))
    name = name.format(name=read_sequence(folder).image_paths[2].name)
    new = outside(how, folder / base, root)
    content = path.read_text().replace(name, new) if layout is not Layout.EUROC else None
    if content is None:
        lines = [f"{x.split(',')[0]},{new}" if x.endswith(name) else x for x in path.read_text().splitlines()]
        content = "\n".join(lines)
    path.write_text(content)
    if layout is Layout.COLMAP:  # where a picture that is not named is a frame without a pose
        (folder / "images" / "0002.png").unlink()
    return folder, file


@pytest.mark.parametrize("layout", NAMED)
@pytest.mark.parametrize("how", ["link", "folder link"])
def test_links_out_of_the_folder_are_followed(tmp_path, layout, how):
    folder, _ = naming_outside(tmp_path, layout, how)
    sequence = read_sequence(folder)
    assert 255 in [sequence.image(i)[0, 0, 0] for i in range(N)]
    assert invoke("data", "check", folder).exit_code == 0


def test_dots_behind_a_link_lead_out_of_the_folder(tmp_path):
    folder, file = naming_outside(tmp_path, Layout.TUM, "folder link")
    (folder / file).write_text((folder / file).read_text().replace("linked/x.png", "linked/../set-other/x.png"))
    with pytest.raises(DatasetError, match="outside"):
        read_sequence(folder)


def test_evaluate_follows_names_out_of_the_truth_only_when_told(tmp_path):
    folder, _ = naming_outside(tmp_path, Layout.TUM, "absolute")
    truth = read_sequence(folder, follow_outside=True).require_truth()
    with ResultsWriter(tmp_path / "out") as writer:
        for i in range(N):
            writer.region(f"{i}", truth.timestamps_s[i], None, [np.array([[-np.inf, np.inf]])] * 7)
        for method in METHODS:
            writer.poses(method, truth)
    write_metrics(tmp_path / "out", {"command": "run", "configuration": {}})
    arguments = ["evaluate", tmp_path / "out", "--truth", folder]
    assert invoke(*arguments).exit_code == 2
    result = invoke(*arguments, "--follow-outside")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("layout", NAMED)
@pytest.mark.parametrize("how", ["absolute", "dots"])
def test_images_outside_the_folder_are_followed_only_when_told(tmp_path, layout, how):
    folder, file = naming_outside(tmp_path, layout, how)
    with pytest.raises(DatasetError, match=rf"{file}: names .*x\.png") as caught:
        read_sequence(folder)
    assert "--follow-outside" in str(caught.value)
    with pytest.raises(DatasetError, match="outside"):
        open_stream(folder)
    sequence = read_sequence(folder, follow_outside=True)
    assert 255 in [sequence.image(i)[0, 0, 0] for i in range(N)]
    assert invoke("data", "check", folder).exit_code == 2
    assert invoke("data", "check", folder, "--follow-outside").exit_code == 0
    assert invoke("data", "convert", folder, "--to", "images", "--out", tmp_path / "out").exit_code == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("layout", [Layout.TUM, Layout.COLMAP, Layout.NERF])
def test_dots_and_links_inside_the_folder_are_followed(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    file, name, base = NAMED[layout]
    path = next(tmp_path.rglob(file))
    (folder / base / "same").symlink_to(".")
    path.write_text(path.read_text().replace(name, f"same/same/{name}"))
    assert len(read_sequence(folder)) == N


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "..", "/", "//", "."])
@pytest.mark.parametrize("layout", [Layout.TUM, Layout.COLMAP, Layout.NERF])
def test_names_that_are_no_files(tmp_path, layout, name):
    folder = WRITERS[layout](tmp_path)
    path = next(tmp_path.rglob(NAMED[layout][0]))
    old = NAMED[layout][1]
    path.write_text(path.read_text().replace(old, json.dumps(name)[1:-1] if layout is Layout.NERF else name))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DatasetWarning)
            assert len(read_sequence(folder)) == N - 1
    except DatasetError as exc:
        assert path.name in str(exc)  # noqa: PT017


# What data check says


@pytest.mark.parametrize("layout", [Layout.TUM, Layout.SEVENSCENES, Layout.KITTI])
def test_check_counts_the_poses_there_are(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    if layout is Layout.SEVENSCENES:
        (tmp_path / "seq-01" / "frame-000000.pose.txt").unlink()
    else:
        path = pose_file(layout, tmp_path)
        lines = path.read_text().splitlines()
        del lines[1 if layout is Layout.TUM else 0]
        path.write_text("\n".join(([] if layout is Layout.TUM else ["nan " * 12]) + lines))
    found = check_sequence(read_sequence(folder, require_poses=False))
    assert found.n_poses == N - 1
    assert any("pose" in finding.what for finding in found.findings)
    assert f"for {N - 1} of {N} frames" in invoke("data", "check", folder).output


OUTS = {
    "another command's metrics": {"metrics.json": '{"command": "run"}'},
    "metrics without a command": {"metrics.json": "{}"},
    "metrics that are none": {"metrics.json": "["},
    "metrics in a list": {"metrics.json": "[1]"},
    "metrics nested deeply": {"metrics.json": "[" * 100_000},
    "a run": {"metrics.json": '{"command": "run"}', "trajectory.tum": "0 0 0 0 0 0 0 1"},
    "a model": {"model.json": "{}", "model.safetensors": "x"},
    "a check and something else": {"metrics.json": '{"command": "data check"}', "trajectory.tum": ""},
    "notes": {"notes.txt": "mine"},
}


@pytest.mark.parametrize("what", OUTS)
def test_check_overwrites_nothing_of_another_kind(tmp_path, what):
    (tmp_path / "a").mkdir()
    folder, out = WRITERS[Layout.TUM](tmp_path / "a"), tmp_path / "out"
    out.mkdir()
    for name, content in OUTS[what].items():
        (out / name).write_text(content)
    result = invoke("data", "check", folder, "--out", out)
    assert result.exit_code == 2
    assert "holds files of another kind" in result.output
    assert {p.name: p.read_text() for p in out.iterdir()} == OUTS[what]


def test_check_overwrites_itself_and_no_file(tmp_path):
    (tmp_path / "a").mkdir()
    folder, out = WRITERS[Layout.TUM](tmp_path / "a"), tmp_path / "out"
    for _ in range(2):
        assert invoke("data", "check", folder, "--out", out).exit_code == 0
    assert json.loads((out / "metrics.json").read_text())["command"] == "data check"
    (tmp_path / "file").write_text("mine")
    assert invoke("data", "check", folder, "--out", tmp_path / "file").exit_code == 2
    assert (tmp_path / "file").read_text() == "mine"
    assert invoke("data", "check", folder, "--out", folder).exit_code == 2


@pytest.mark.parametrize("name", ["[red]a[/b]", "[/]", "a b", "-a", "\u00fc\u4e2d", "%s {} $(ls)", "a\nb"])
def test_folders_of_any_name_are_read(tmp_path, name):
    root = tmp_path / name
    root.mkdir(parents=True)
    folder = WRITERS[Layout.IMAGES](root)
    assert len(read_sequence(folder)) == N
    assert invoke("data", "check", folder).exit_code == 0
    result = invoke("data", "convert", folder, "--to", "tum", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(
    "settings",
    [{"seed": -1}, {"seed": 0.5}, {"n_blocks": 0}, {"n_blocks": -3}, {"test": NAN}, {"calibration": 0}, {"used": NAN}],
)
def test_splits_that_are_none_are_refused(settings):
    with pytest.raises(SplitError):
        make_split(np.zeros(50, dtype=np.int64), "blocks", **settings)


@pytest.mark.parametrize("settings", [{"sigma": NAN}, {"sigma": -1}, {"sigma": 0.1, "seed": -1}])
def test_noise_that_is_none_is_refused(settings):
    with pytest.raises(DatasetError):
        PixelNoise(**settings)


# Trajectories by themselves stay strict


@pytest.mark.parametrize("read", [read_tum, read_kitti, read_euroc])
@pytest.mark.parametrize("content", [b"", b"\xff\n", b"1 2 3\n", b"nan " * 12, b"1e400 " * 8, b"1_0 " * 8, bytes(99)])
def test_a_trajectory_that_is_none_is_refused_whole(tmp_path, read, content):
    (tmp_path / "t.txt").write_bytes(content)
    with pytest.raises(PoseError, match=r"t\.txt"):
        read(tmp_path / "t.txt")


@pytest.mark.parametrize("line", ["2 0 0 0 0 0 0 0", "2 nan 0 0 0 0 0 1", "2 0 0", "2 1e99 0 0 0 0 0 1"])
def test_one_bad_pose_of_a_trajectory_refuses_it(tmp_path, line):
    (tmp_path / "t.txt").write_text(f"1 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(PoseError, match=r"t\.txt"):
        read_tum(tmp_path / "t.txt")


@pytest.mark.parametrize("times", [[0.0, NAN], [0.0, float("inf")], [[0.0], [1.0]]])
def test_a_trajectory_needs_finite_times(times):
    with pytest.raises(PoseError, match="timestamps_s must be finite"):
        Trajectory(np.array(times), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))


def test_nothing_cannot_be_paired_or_turned():
    none, one = (Trajectory(np.zeros(n), np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1))) for n in (0, 1))
    for pair in ((none, one), (one, none)):
        with pytest.raises(PoseError, match="cannot be paired"):
            associate(*pair)
    with pytest.raises(PoseError):
        matrix_from_quat_wxyz(np.zeros((2, 4)))
