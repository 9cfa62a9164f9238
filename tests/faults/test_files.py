"""A bad file, line or name costs one frame, which is named; nothing shifts, and nothing outside the folder is read."""

import json
import os
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from conformodal.io import DatasetError, DatasetWarning, ImageError, Layout, read_recording
from conformodal.io.streams.opening import open_stream
from conformodal.io.streams.stored import RecordingStream
from tests.helpers import contents, invoke, run_ok
from tests.io.test_layouts import WRITERS, N
from tests.io.test_refusals import file_of

LISTS = {Layout.TUM: "rgb.txt", Layout.EUROC: "mav0/cam0/data.csv"}


def expect(folder, layout, before, lost, match, *, always=False):
    """One frame is lost to training and named; the others are as before. `always`: to every reading."""
    kept = [i for i in range(N) if i != lost]
    with pytest.warns(DatasetWarning, match=match):
        sequence = read_recording(folder, layout)
    assert sequence.image_paths == tuple(before.image_paths[i] for i in kept)
    np.testing.assert_allclose(sequence.timestamps_s, before.timestamps_s[kept])
    np.testing.assert_allclose(sequence.require_truth().poses_se3, before.truth.poses_se3[kept], atol=1e-9)
    assert sequence.camera == before.camera
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)
        everything = read_recording(folder, layout, require_poses=False)
    assert everything.image_paths == (sequence.image_paths if always else before.image_paths)
    if layout is Layout.TUM:
        assert invoke("data", "check", folder, "--format", layout).exit_code == 1


def replaced(make):
    def change(path):
        path.unlink()
        make(path)

    return change


UNREADABLE = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:60]),
    "text": lambda path: path.write_text("404: Not Found"),
    "a folder": replaced(Path.mkdir),
    "a pipe": replaced(os.mkfifo),
    "a broken link": replaced(lambda path: path.symlink_to("nowhere.png")),
    "a link to itself": replaced(lambda path: path.symlink_to(path.name)),
    "a device": replaced(lambda path: path.symlink_to("/dev/zero")),
    "another size": lambda path: Image.new("RGB", (128, 96)).save(path),
}


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("damage", UNREADABLE)
def test_a_bad_image_costs_its_frame(tmp_path, layout, damage):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    place = (list(WRITERS).index(layout) + list(UNREADABLE).index(damage)) % 2 * 3  # the first, or one in the middle
    UNREADABLE[damage](before.image_paths[place])
    expect(folder, layout, before, place, before.image_paths[place].name)
    frames = list(RecordingStream(read_recording(folder, require_poses=False)))
    assert [frame.image is None for frame in frames] == [i == place for i in range(N)]


# where the pose of frame 2 is: its file, the separator, the words of the pose, the first number of the position
LINES = {
    Layout.TUM: ("groundtruth.txt", " ", slice(1, 8), 0),
    Layout.IMAGES: ("poses.tum", " ", slice(1, 8), 0),
    Layout.EUROC: ("state_groundtruth_estimate0/data.csv", ",", slice(1, 8), 0),
    Layout.RGBD_SCENES: ("02.pose", " ", slice(0, 7), 4),
    Layout.KITTI: ("07.txt", " ", slice(0, 12), 3),
    Layout.COLMAP: ("images.txt", " ", slice(1, 8), 4),
}
MATRIX = (Layout.KITTI, Layout.SEVENSCENES, Layout.NERF)


def change_pose(layout, root, change):
    """Change the words of frame 2's pose, as they are in its file."""
    if layout is Layout.SEVENSCENES:
        path = file_of(root, "frame-000002.pose.txt")
        path.write_text(" ".join(change(path.read_text().split())))
    elif layout is Layout.NERF:
        path = root / "transforms.json"
        content = json.loads(path.read_text())
        frame = next(f for f in content["frames"] if "0002" in f["file_path"])
        words = list(map(float, change([str(v) for row in frame["transform_matrix"] for v in row])))
        frame["transform_matrix"] = [words[k : k + 4] for k in range(0, len(words), 4)]
        path.write_text(json.dumps(content))
    else:
        name, separator, place, _ = LINES[layout]
        path = file_of(root, name)
        lines = path.read_text().splitlines()
        at = [k for k, line in enumerate(lines) if not line.startswith("#")][2]
        if layout is Layout.COLMAP:
            at = next(k for k, line in enumerate(lines) if line.endswith("0002.png"))
        words = lines[at].split(separator)
        words[place] = change(words[place])
        lines[at] = separator.join(words)
        path.write_text("\n".join(lines) + "\n")


def position(value):
    return lambda layout: (
        lambda words: [value if k == LINES.get(layout, (3,))[-1] else word for k, word in enumerate(words)]
    )


def rotation(layout, value):
    """The words with all numbers of the rotation replaced, by place."""
    place = LINES.get(layout, (3,))[-1]
    held = [place, place + 1, place + 2] if layout not in MATRIX else [3, 7, 11, 12, 13, 14, 15]
    return lambda words: [word if k in held else value(k, word) for k, word in enumerate(words)]


POSES = {
    **{f"a number is {value!r}": position(value) for value in ("nan", "-inf", "1e400", "1_0", "lost", "1;5", "\u0661")},
    "a NUL": position("1\0"),
    "a long word": position("1" * 100_000 + "x"),
    "far away": position("1e200"),
    "cut": lambda _: lambda words: words[: len(words) // 3],
    "no direction": lambda layout: rotation(layout, lambda k, word: "0"),
    "too large": lambda layout: rotation(layout, lambda k, word: "2.5" if k == 0 else word),
    "a mirror": lambda layout: rotation(layout, lambda k, word: str(-float(word)) if k % 4 == 0 else word),
    "a last row": lambda _: lambda words: [*words[:-1], "2.0"],
}
NUMBERS = {"far away", "no direction", "too large", "a mirror", "a last row"} | {
    f"a number is {value!r}" for value in ("nan", "-inf", "1e400")
}
ROWS = [
    (what, layout)
    for what in POSES
    for layout in WRITERS
    if layout in MATRIX or what not in ("too large", "a mirror")  # quaternions are scaled, and have no mirrors
    if layout in (Layout.SEVENSCENES, Layout.NERF) or what != "a last row"
    if layout not in (Layout.COLMAP, Layout.NERF) or what in NUMBERS  # what is not a number costs the file
]


@pytest.mark.parametrize(("what", "layout"), ROWS)
def test_a_bad_pose_costs_its_frame(tmp_path, what, layout):
    folder = WRITERS[layout](tmp_path)
    for truth in tmp_path.rglob("state_groundtruth_estimate0"):  # a lost row of 20 Hz would be bridged
        (truth / "max-gap.txt").write_text("0.06")
    before = read_recording(folder)
    change_pose(layout, tmp_path, POSES[what](layout))
    expect(folder, layout, before, 2, before.image_paths[2].name)


POSE_FILES = {
    "missing": Path.unlink,
    "bytes": lambda path: path.write_bytes(b"\xff\xfe\x001\x00"),
    **{name: change for name, change in UNREADABLE.items() if name in ("empty", "a folder", "a pipe", "a broken link")},
}


@pytest.mark.parametrize("what", POSE_FILES)
def test_a_7_scenes_pose_that_is_not_a_file_costs_its_frame(tmp_path, what):
    folder, place = WRITERS[Layout.SEVENSCENES](tmp_path), 3
    before = read_recording(folder)
    POSE_FILES[what](tmp_path / "seq-01" / f"frame-{place:06d}.pose.txt")
    expect(folder, Layout.SEVENSCENES, before, place, rf"frame-{place:06d}\.color\.png: .*frame-{place:06d}\.pose")
    some = read_recording(folder, require_poses=False)
    assert some.truth is None
    assert len(some.known_poses) == N - 1


@pytest.mark.parametrize("layout", WRITERS)
def test_a_data_set_without_one_sound_image_is_refused(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    for path in read_recording(folder).image_paths:
        path.write_bytes(b"")
    with pytest.raises(ImageError, match="cannot be decoded"):
        read_recording(folder)


JUNK = ["._{name}", ".DS_Store", "Thumbs.db", "desktop.ini", ".{name}.swp", "{name}.part", ".hidden.png"]


def expect_the_same(folder, before):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        after = read_recording(folder)
    assert (after.image_paths, after.camera, after.notes) == (before.image_paths, before.camera, ())
    np.testing.assert_array_equal(after.timestamps_s, before.timestamps_s)
    np.testing.assert_array_equal(after.truth.positions_xyz, before.truth.positions_xyz)


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("junk", JUNK)
def test_what_systems_leave_behind_is_no_frame(tmp_path, layout, junk):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    for path in {p.parent for p in tmp_path.rglob("*") if p.is_file()}:
        (path / junk.format(name=before.image_paths[0].name)).write_bytes(b"\0\5\x16\7")
    expect_the_same(folder, before)


# Damage to one time

TIMES = {
    "NaN": lambda times: "nan",
    "infinite": lambda times: "inf",
    "overflowing": lambda times: "1e400",
    "twice": lambda times: times[1],
    "decreasing": lambda times: times[0],
    "far ahead": lambda times: str(9 * int(times[2])) if times[2].isdigit() else f"{9 * float(times[2])}",
}


@pytest.mark.parametrize("what", TIMES)
@pytest.mark.parametrize("layout", [Layout.TUM, Layout.KITTI, Layout.IMAGES, Layout.EUROC])
def test_a_bad_time_costs_its_frame(tmp_path, what, layout):
    folder = WRITERS[layout](tmp_path)
    if layout is Layout.IMAGES:
        for i, path in enumerate(sorted(folder.glob("*.png"))):
            path.rename(folder / f"{i}.png")
        (folder / "times.txt").write_text("\n".join(f"{100 + 0.1 * i}" for i in range(N)))
    before = read_recording(folder)
    path = folder / LISTS.get(layout, "times.txt")
    separator = "," if layout is Layout.EUROC else " "
    lines = [line.split(separator) for line in path.read_text().splitlines() if not line.startswith("#")]
    lines[2][0] = TIMES[what]([line[0] for line in lines])
    path.write_text("\n".join(map(separator.join, lines)))
    expect(folder, layout, before, 2, rf"{path.name}|{before.image_paths[2].name}", always=True)


@pytest.mark.parametrize("rate", ["nan", "0", "-3", "inf", "1e-300", "1e300", "30 30", "", "3_0", "\u0663"])
@pytest.mark.parametrize("layout", [Layout.SEVENSCENES, Layout.COLMAP, Layout.NERF])
def test_a_frame_rate_that_is_none_is_refused(tmp_path, layout, rate):
    folder = WRITERS[layout](tmp_path)
    (tmp_path / "frame-rate.txt").write_text(rate)
    with pytest.raises(DatasetError, match=r"frame-rate\.txt: (holds|cannot be read)"):
        read_recording(folder)


@pytest.mark.parametrize("layout", LISTS)
@pytest.mark.parametrize(
    "line", ["lost", "12", "x,y", "1\0 2", "now rgb/0.png", "1_0 rgb/0.png", "1_0,0.png", ",", "5,"]
)
def test_a_bad_line_of_images_is_left_out(tmp_path, layout, line):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    path = folder / LISTS[layout]
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], line, *lines[3:]]))
    with pytest.warns(DatasetWarning, match=rf"{path.name}, line 4: expected"):
        after = read_recording(folder)
    assert after.image_paths == before.image_paths
    np.testing.assert_array_equal(after.truth.positions_xyz, before.truth.positions_xyz)


CHANGES = {
    "BOM": lambda content: b"\xef\xbb\xbf" + content,
    "CRLF": lambda content: content.replace(b"\n", b"\r\n"),
    "BOM and CRLF": lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"),
    "CR": lambda content: content.replace(b"\n", b"\r"),
    "no last newline": lambda content: content.rstrip(b"\n"),
    "blank lines at the end": lambda content: content.rstrip(b"\n") + b"\n\n\n",
}


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("change", CHANGES)
def test_texts_of_other_systems_are_read_the_same(tmp_path, layout, change):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    for path in [p for p in tmp_path.rglob("*") if p.suffix in (".txt", ".csv", ".yaml", ".json", ".pose", ".tum")]:
        path.write_bytes(CHANGES[change](path.read_bytes()))
    expect_the_same(folder, before)


def test_a_name_that_is_not_utf_8_costs_its_frame(tmp_path):
    folder = WRITERS[Layout.IMAGES](tmp_path)
    before = read_recording(folder)
    for i, path in enumerate(before.image_paths):
        path.rename(os.fsdecode(os.fsencode(folder) + (b"/%d.png" % i if i != 2 else b"/2\xff.png")))
    np.savetxt(folder / "poses.txt", before.truth.poses_se3[:, :3].reshape(N, 12))
    (folder / "poses.tum").unlink()
    with pytest.warns(DatasetWarning, match="not UTF-8"):
        after = read_recording(folder)
    np.testing.assert_allclose(after.truth.positions_xyz, np.delete(before.truth.positions_xyz, 2, axis=0), atol=1e-9)
    result = invoke("data", "check", folder)
    assert result.exit_code == 1, result.output
    assert r"2\xff.png" in result.output


def outside(how, folder, root):
    """A name that leads from a folder of images to another one beside the data set."""
    image = root.parent / f"{root.name}-other" / "x.png"
    image.parent.mkdir()
    Image.new("RGB", (64, 48), (255, 0, 0)).save(image)
    if how == "link":
        (folder / "link.png").symlink_to(image)
    elif how == "folder link":
        (folder / "linked").symlink_to(image.parent)
    return {"absolute": str(image), "dots": os.path.relpath(image, folder), "link": "link.png"}.get(how, "linked/x.png")


# the file that names the images, how it names that of frame 2, and the folder that this is relative to
NAMED = {
    Layout.TUM: ("rgb.txt", " rgb/2.png", ""),
    Layout.EUROC: ("data.csv", ",{name}", "mav0/cam0/data"),
    Layout.COLMAP: ("images.txt", " 0002.png", "images"),
    Layout.NERF: ("transforms.json", '"./images/0002', ""),
}


def naming_outside(tmp_path, layout, how):
    """A data set of which one image lies beside it, and the file that names it."""
    root = tmp_path / "set"
    root.mkdir()
    folder = WRITERS[layout](root)
    file, name, base = NAMED[layout]
    path = next(root.rglob(file))
    name = name.format(name=read_recording(folder).image_paths[2].name)
    path.write_text(path.read_text().replace(name, name[0] + outside(how, folder / base, root)))
    if layout is Layout.COLMAP:  # where a picture that is not named is a frame without a pose
        (folder / "images" / "0002.png").unlink()
    return folder, file


@pytest.mark.parametrize("layout", NAMED)
@pytest.mark.parametrize("how", ["link", "folder link"])
def test_links_out_of_the_folder_are_followed(tmp_path, layout, how):
    sequence = read_recording(naming_outside(tmp_path, layout, how)[0])
    assert 255 in [sequence.image(i)[0, 0, 0] for i in range(N)]


def test_dots_behind_a_link_lead_out_of_the_folder(tmp_path):
    folder, file = naming_outside(tmp_path, Layout.TUM, "folder link")
    (folder / file).write_text((folder / file).read_text().replace("linked/x.png", "linked/../set-other/x.png"))
    with pytest.raises(DatasetError, match="outside"):
        read_recording(folder)


@pytest.mark.parametrize("layout", NAMED)
@pytest.mark.parametrize("how", ["absolute", "dots"])
def test_images_outside_the_folder_are_followed_only_when_told(tmp_path, layout, how):
    folder, file = naming_outside(tmp_path, layout, how)
    with pytest.raises(DatasetError, match=rf"{file}: names .*x\.png") as caught:
        read_recording(folder)
    assert "--follow-outside" in str(caught.value)
    with pytest.raises(DatasetError, match="outside"):
        open_stream(folder)
    sequence = read_recording(folder, follow_outside=True)
    assert 255 in [sequence.image(i)[0, 0, 0] for i in range(N)]
    if layout is Layout.TUM:
        assert invoke("data", "check", folder).exit_code == 2
        assert invoke("data", "check", folder, "--follow-outside").exit_code == 0
        assert invoke("data", "convert", folder, "--to", "images", "--out", tmp_path / "out").exit_code == 2
        assert not (tmp_path / "out").exists()


# the image of frame 2 is named so; without an answer, the frame is lost, or else the file is refused
NO_FILES = {"a\0b": "no file name", "x" * 5000: None, "..": "outside", "/": "outside", ".": None}


@pytest.mark.parametrize("name", NO_FILES)
@pytest.mark.parametrize("layout", [Layout.TUM, Layout.COLMAP, Layout.NERF])
def test_names_that_are_no_files(tmp_path, layout, name):
    folder = WRITERS[layout](tmp_path)
    path = next(tmp_path.rglob(NAMED[layout][0]))
    old = NAMED[layout][1]
    path.write_text(path.read_text().replace(old, old[0] + (json.dumps(name)[1:-1] if layout is Layout.NERF else name)))
    match = "expected 'id" if layout is Layout.COLMAP and name in (".", "..") else NO_FILES[name]
    if match is None:
        with pytest.warns(DatasetWarning, match="1 x left out"):
            assert len(read_recording(folder)) == N - 1
    else:
        with pytest.raises(DatasetError, match=rf"{path.name}.*{match}"):
            read_recording(folder)


def test_check_overwrites_itself_and_no_file(tmp_path):
    folder, out = WRITERS[Layout.TUM](tmp_path / "a"), tmp_path / "out"
    for _ in range(2):
        assert invoke("data", "check", folder, "--out", out).exit_code == 0
    assert json.loads((out / "metrics.json").read_text())["command"] == "data check"
    (tmp_path / "file").write_text("mine")
    for other in (tmp_path / "file", folder):
        before = contents(tmp_path)
        assert invoke("data", "check", folder, "--out", other).exit_code == 2
        assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["[red]a[/b]", "-a \u00fc\u4e2d\n%s {} $(ls)"])
def test_folders_of_any_name_are_read(tmp_path, name):
    root = tmp_path / name
    root.mkdir(parents=True)
    folder = WRITERS[Layout.IMAGES](root)
    assert len(read_recording(folder)) == N
    assert invoke("data", "check", folder).exit_code == 0
    run_ok("data", "convert", folder, "--to", "tum", "--out", tmp_path / "out")


def test_two_poses_for_one_time_are_no_pose(tmp_path):
    folder = WRITERS[Layout.TUM](tmp_path)
    before = read_recording(folder)
    path = folder / "groundtruth.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, " ".join([lines[3].split()[0], "7", *lines[3].split()[2:]])]) + "\n")
    expect(folder, Layout.TUM, before, 2, "2.png: no pose within")
    assert "two poses for time" in read_recording(folder).notes[0].where


@pytest.mark.parametrize("layout", [Layout.AUTO, *WRITERS])
@pytest.mark.parametrize("what", ["nowhere", "file", "empty"])
def test_what_is_no_data_set_is_refused(tmp_path, layout, what):
    path = tmp_path / "a"
    if what == "file":
        path.write_text("x")
    elif what == "empty":
        path.mkdir()
    with pytest.raises(DatasetError):
        read_recording(path, layout)
