import struct
import time
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import islice
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from conformodal.geometry import PinholeCamera
from conformodal.io import DatasetError, DatasetWarning, read_recording
from conformodal.io.diagnosis.recordings import describe_unopened
from conformodal.io.streams import Frame, RecordingStream, SourceError, open_stream, prefetch
from conformodal.io.streams.bag import BagStream
from conformodal.io.streams.frames import frame_names
from conformodal.io.streams.ros_messages import COMPRESSED, RAW, camera_of_info, image_of
from conformodal.io.streams.video import CameraStream, VideoStream

SIZE = (64, 48)


def video(path, n=12, fps=10, size=SIZE):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, size)
    for i in range(n):
        image = np.zeros((size[1], size[0], 3), np.uint8)
        image[:, :, 2] = 20 * i % 256  # red, in OpenCV's order
        writer.write(image)
    writer.release()
    return path


def test_a_video_gives_its_frames_in_rgb_with_their_times(tmp_path):
    stream = open_stream(video(tmp_path / "v.avi"))
    assert isinstance(stream, VideoStream)
    assert stream.n_frames == 12
    frames = list(stream)
    np.testing.assert_allclose([f.timestamp_s for f in frames], 0.1 * np.arange(12), atol=1e-6)
    assert [round(f.image[..., 0].mean() / 20) for f in frames] == list(range(12))
    assert max(f.image[..., 2].mean() for f in frames) < 12
    assert frames[3].name == "v-000003"


def test_truncated_video_gives_its_frames_and_warns(tmp_path):
    path = video(tmp_path / "v.avi", n=60, size=(320, 240))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(DatasetWarning, match=r"v\.avi: ends after \d+ of 60 frames"):
        frames = list(open_stream(path))
    assert 10 < len(frames) < 45


@pytest.mark.parametrize("damaged", [0, 9, 29])
def test_a_damaged_frame_costs_that_frame(tmp_path, damaged):
    path = tmp_path / "v.avi"
    content = bytearray(video(path, n=30, size=(320, 240)).read_bytes())
    at = -1
    for _ in range(damaged + 1):
        at = content.find(b"\xff\xd8\xff", at + 1)
    content[at + 2 : at + 300] = bytes(298)
    path.write_bytes(content)
    with nullcontext() if damaged < 29 else pytest.warns(DatasetWarning, match="ends after 29 of 30 frames"):
        frames = list(open_stream(path))
    without = [i for i, frame in enumerate(frames) if frame.image is None]
    assert without == ([damaged] if damaged < 29 else [])
    assert len(frames) == (30 if damaged < 29 else 29)
    np.testing.assert_allclose([f.timestamp_s for f in frames], 0.1 * np.arange(len(frames)), atol=1e-6)
    assert all(frames[i].problem == f"{path}: frame {i} cannot be decoded" for i in without)


def mp4(path, n=30, codec="mp4v"):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 10, SIZE)
    for i in range(n):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 8 * i, np.uint8))
    writer.release()
    return bytearray(path.read_bytes())


def timed(path, runs, length_ms):
    """An MP4 file of runs of frames, each with the number of frames and the steps of 0.1 s between them."""
    content = mp4(path)
    at = content.find(b"stts") - 4
    step = int.from_bytes(content[at + 20 : at + 24])
    entries = [len(runs), *(int(v) for count, steps in runs for v in (count, steps * step))]
    box = b"stts" + bytes(4) + b"".join(v.to_bytes(4) for v in entries)
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        k = content.find(name) - 4
        content[k : k + 4] = (int.from_bytes(content[k : k + 4]) + len(box) - 20).to_bytes(4)
    content[at : at + 24] = (len(box) + 4).to_bytes(4) + box
    k = content.find(b"elst") + 12
    content[k : k + 4] = length_ms.to_bytes(4)
    path.write_bytes(content)


def test_frames_of_a_variable_rate_have_their_own_times(tmp_path):
    path = tmp_path / "v.mp4"
    timed(path, [(10, 1), (10, 2), (10, 0.5)], length_ms=3500)  # ten frames each of 0.1, 0.2 and 0.05 s
    frames = list(open_stream(path))
    times = np.cumsum(np.repeat([0.1, 0.2, 0.05], 10))
    np.testing.assert_allclose([f.timestamp_s for f in frames], [0, *times[:-1]], atol=2e-3)
    assert [round(f.image.mean() / 8) for f in frames] == list(range(30))


def shown_by(path, *matrix, header=b"tkhd", at=44):
    """An MP4 file with the a b c d of a display matrix."""
    content, (a, b, c, d) = mp4(path), (round(65536 * v) for v in matrix)
    at += content.find(header)
    values = [a, b, 0, c, d, 0, 0, 0, 1 << 30]
    content[at : at + 36] = b"".join(v.to_bytes(4, signed=True) for v in values)
    path.write_bytes(content)
    return path


def test_turned_video_is_reported_and_slanted_one_refused(tmp_path):
    path = shown_by(tmp_path / "v.mp4", 0, 1, -1, 0)  # by a quarter to the right
    stream = open_stream(path)
    assert next(iter(stream)).image.shape == (SIZE[0], SIZE[1], 3)
    assert any("by 90 degrees" in where for _, where in stream.notes)
    path.write_bytes(mp4(path))
    assert open_stream(path).notes == ()
    with pytest.raises(SourceError, match=r"v\.mp4: .* turned by 45 degrees"):
        open_stream(shown_by(path, 0.707, 0.707, -0.707, 0.707))


@pytest.mark.parametrize("matrix", [(-1, 0, 0, 1), (0, 1, 1, 0)])
@pytest.mark.parametrize(("header", "at"), [(b"tkhd", 44), (b"mvhd", 40)])  # a track, the whole movie
def test_a_video_that_is_shown_mirrored_is_refused(tmp_path, matrix, header, at):
    with pytest.raises(SourceError, match=r"v\.mp4: .* mirrored"):
        open_stream(shown_by(tmp_path / "v.mp4", *matrix, header=header, at=at))


class FakeCapture:
    """A camera that is unplugged after three frames."""

    def __init__(self, _):
        self.left, self.released = 3, False

    def isOpened(self):
        return True

    def set(self, *_):
        return True

    def read(self):
        self.left -= 1
        return (True, np.zeros((48, 64, 3), np.uint8)) if self.left >= 0 else (False, None)

    def release(self):
        self.released = True


def test_unplugged_camera_is_named_and_frames_are_kept(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    stream = open_stream("camera:2")
    assert isinstance(stream, CameraStream)
    assert stream.live
    assert stream.n_frames is None
    frames = []
    with pytest.raises(SourceError, match="camera 2: gives no more frames after 3"):
        frames += stream
    assert len(frames) == 3


# ROS recordings, written by rosbags' own writers


def messages(store, *, encoding="bgr8", header_times=None, compressed=False, form="png"):
    """Six images with blue rising, half a second apart, and one CameraInfo."""
    types = store.types
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    times = 100 + 0.5 * np.arange(6) if header_times is None else header_times
    found = []
    for i, t in enumerate(times):
        extra = {"seq": i} if "seq" in header.__dataclass_fields__ else {}
        head = header(stamp=stamp(sec=int(t), nanosec=round((t % 1) * 1e9)), frame_id="cam", **extra)
        channels = {"mono8": 1}.get(encoding, 3)
        image = np.zeros((48, 64, channels), np.uint8)
        image[..., 0] = 40 * i
        if compressed:
            data = cv2.imencode(".png", image)[1].ravel() if form == "png" else np.arange(99, dtype=np.uint8)
            found.append((head, types["sensor_msgs/msg/CompressedImage"](header=head, format=form, data=data)))
        else:
            padded = np.zeros((48, 64 * channels + 8), np.uint8)  # rows may be padded
            padded[:, : 64 * channels] = image.reshape(48, -1)
            kind = types["sensor_msgs/msg/Image"]
            step = padded.shape[1]
            data = padded.ravel()
            found.append(
                (head, kind(header=head, height=48, width=64, encoding=encoding, is_bigendian=0, step=step, data=data))
            )
    return found


def camera_info(store, head):
    kind = store.types["sensor_msgs/msg/CameraInfo"]
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    values = {"d": np.array([-0.1, 0.02, 0.001, 0.002, 0.0]), "k": np.array([40.0, 0, 32, 0, 41, 24, 0, 0, 1])}
    values |= {"r": np.eye(3).ravel(), "p": np.zeros(12)}
    names = kind.__dataclass_fields__
    values = {k if k in names else k.upper(): v for k, v in values.items()}
    common = {"header": head, "height": 48, "width": 64, "distortion_model": "plumb_bob"}
    return kind(**common, **values, binning_x=0, binning_y=0, roi=roi)


def write_bag(path, kind, *, topic="/cam/image_raw", image_options=None, with_info=True, others=()):
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if kind == "ros1":
        writer, serialize = Writer1(path), store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer, serialize = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
    images = messages(store, **(image_options or {})) if topic else []
    with writer:
        for name, message_type in others:
            writer.add_connection(name, message_type, typestore=store)
        if not images:
            return path
        info = writer.add_connection("/cam/camera_info", "sensor_msgs/msg/CameraInfo", typestore=store)
        message_type = images[0][1].__msgtype__
        connection = writer.add_connection(topic, message_type, typestore=store)
        if with_info:
            writer.write(info, int(99e9), serialize(camera_info(store, images[0][0]), "sensor_msgs/msg/CameraInfo"))
        for i, (_, message) in enumerate(images):
            writer.write(connection, int((100 + i) * 1e9), serialize(message, message_type))
    return path


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_ros_recordings_of_every_kind(tmp_path, kind):
    path = write_bag(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind)
    stream = open_stream(path)
    assert isinstance(stream, BagStream)
    assert stream.n_frames == 6
    assert (stream.camera.fx, stream.camera.fy, stream.camera.width) == (40, 41, 64)
    assert stream.camera.distortion == (-0.1, 0.02, 0.001, 0.002, 0.0)
    frames = list(stream)
    np.testing.assert_allclose([f.timestamp_s for f in frames], 100 + 0.5 * np.arange(6), atol=1e-9)
    assert [int(f.image[0, 0, 2]) for f in frames] == [40 * i for i in range(6)]  # blue comes last in RGB
    if kind == "mcap":
        (file,) = path.glob("*.mcap")
        alone = file.rename(tmp_path / "alone.mcap")  # a file by itself, without ROS's metadata
        assert open_stream(alone).n_frames == 6
        assert len(list(open_stream(alone))) == 6


def message(image, encoding, *, pad=6):
    """A raw image message of an array (rows, width, n), with padded rows."""
    data = np.pad(image.reshape(len(image), -1).view(np.uint8), ((0, 0), (0, pad)))
    size = {"height": len(image), "width": image.shape[1], "step": data.shape[1], "is_bigendian": 0}
    return SimpleNamespace(encoding=encoding, data=data.ravel(), **size)


RED = np.full((8, 12, 3), (200, 60, 30), np.uint8)


def in_encoding(rgb, encoding):
    """A picture of one colour as a camera sends it, by the formats' definitions."""
    (r, g, b), (h, w) = rgb[0, 0].tolist(), rgb.shape[:2]
    if encoding.startswith("bayer"):
        tile = np.array([{"r": r, "g": g, "b": b}[c] for c in encoding.split("_")[1][:4]], np.uint8).reshape(2, 2)
        return np.tile(tile, (h // 2, w // 2))[..., None]
    if encoding.lower() in ("rgb8", "bgr8", "8uc3"):
        return rgb if encoding.lower() == "rgb8" else rgb[:, :, ::-1].copy()
    y, u = round(16 + (66 * r + 129 * g + 25 * b) / 256), round(128 + (-38 * r - 74 * g + 112 * b) / 256)
    v = round(128 + (112 * r - 94 * g - 18 * b) / 256)
    pair = (u, y, v, y) if encoding in ("yuv422", "uyvy") else (y, u, y, v)
    return np.tile(pair, (h, w // 2)).reshape(h, w, 2).astype(np.uint8)


@pytest.mark.parametrize(
    "encoding",
    ["rgb8", "RGB8", "bgr8", "8UC3", "yuv422", "uyvy", "yuv422_yuy2", "yuyv"]
    + [f"bayer_{order}8" for order in ("rggb", "bggr", "gbrg", "grbg")],
)
def test_a_colour_is_the_same_in_every_encoding(encoding):
    image = image_of(message(in_encoding(RED, encoding), encoding), RAW)
    assert image.shape == RED.shape
    np.testing.assert_allclose(image[2:-2, 2:-2].astype(int), RED[2:-2, 2:-2].astype(int), atol=3)


def compressed(image, form):
    return SimpleNamespace(format=form, data=cv2.imencode(".png", image)[1].ravel())


@pytest.mark.parametrize(
    "form", ["rgb8; png compressed bgr8", "png compressed rgb8", "bayer_rggb8; png compressed bgr8"]
)
def test_the_colours_of_compressed_images(form):
    np.testing.assert_array_equal(image_of(compressed(RED[..., ::-1], form), COMPRESSED), RED)
    swapped = compressed(RED, "rgb8; png compressed rgb8")  # of image_transport
    np.testing.assert_array_equal(image_of(swapped, COMPRESSED), RED)


@pytest.mark.parametrize(
    ("sent", "kind", "match"),
    [(message(RED, one), RAW, f"encoding {one} is none of") for one in ("mono16", "rgb16", "nv12", "32FC1")]
    + [(message(np.zeros((4, 5, 2), np.uint8), "yuv422"), RAW, "5x4 pixels cannot be yuv422")]
    + [
        (
            compressed(RED, f"{one}; png compressed "),
            COMPRESSED,
            f"images are '{one}; png compressed ', expected 8 bits",
        )
        for one in ("mono16", "bayer_rggb8")
    ],
)
def test_images_that_would_be_decoded_wrongly_are_refused(sent, kind, match):
    with pytest.raises(SourceError, match=match):
        image_of(sent, kind)


K_INFO = np.array([80.0, 0, 64, 0, 82, 48, 0, 0, 1])
P_INFO = np.array([70.0, 0, 60, 5, 0, 71, 44, 0, 0, 0, 1, 0])


def info(*, roi=(0, 0, 0, 0), binning=(0, 0), model="plumb_bob", d=(-0.1, 0.02, 0.001, 0.002, 0.0), k=K_INFO, p=P_INFO):
    x, y, width, height = roi
    window = SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height, do_rectify=False)
    head = {"width": 128, "height": 96, "binning_x": binning[0], "binning_y": binning[1], "roi": window}
    return SimpleNamespace(k=k, p=p, d=np.array(d), distortion_model=model, **head)


@pytest.mark.parametrize(
    ("topic", "given", "expected"),
    [
        ("/cam/image_raw", {}, (80, 82, 64, 48, 128, 96)),
        ("/cam/image_rect", {}, (70, 71, 60, 44, 128, 96)),
        ("/cam/image_rect_color/compressed", {}, (70, 71, 60, 44, 128, 96)),
        ("/cam/image_rect", {"k": np.zeros(9)}, (70, 71, 60, 44, 128, 96)),
        ("/cam/image_rect", {"p": np.zeros(12), "d": np.zeros(4), "model": "equidistant"}, (80, 82, 64, 48, 128, 96)),
        ("/cam/image_raw", {"binning": (2, 2)}, (40, 41, 32, 24, 64, 48)),
        ("/cam/image_raw", {"roi": (32, 24, 64, 48)}, (80, 82, 32, 24, 64, 48)),
        ("/cam/image_raw", {"roi": (32, 16, 64, 64), "binning": (2, 4)}, (40, 20.5, 16, 8, 32, 16)),
        ("/cam/image_rect", {"roi": (20, 4, 80, 80), "binning": (2, 2)}, (35, 35.5, 20, 20, 40, 40)),
    ],
)
def test_the_matrix_window_and_binning_of_a_camera_info_are_used(topic, given, expected):
    notes = []
    camera = camera_of_info(info(**given), "info", topic, notes=notes)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == expected
    rectified = "rect" in topic
    assert camera.distortion == (() if rectified else (-0.1, 0.02, 0.001, 0.002, 0.0))
    by_p = rectified and "p" not in given
    assert any(("P, without distortion" if by_p else "K and D") in where for _, where in notes)


def ramp(width, height, scale):
    y, x = np.mgrid[:height, :width] * scale
    return np.dstack((4 * x, 5 * y, 0 * x)).astype(np.uint8)


def write_ramps(path, changes):
    """A bag of one ramp per change of the CameraInfo that comes before it."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {"/cam/camera_info": "sensor_msgs/msg/CameraInfo", "/cam/image_raw": "sensor_msgs/msg/Image"}
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        to = {name: writer.add_connection(name, kind, typestore=store) for name, kind in kinds.items()}
        for i, (change, scale) in enumerate(changes):
            (head, _), *_ = messages(store, header_times=[100.0 + i])
            made = camera_info(store, head)
            size = {"width": round(64 / scale), "height": round(48 / scale)}
            for name, value in {"d": np.zeros(5), **size, **change}.items():
                object.__setattr__(made, name, value)
            pixels = ramp(made.width, made.height, scale)[..., ::-1]
            size = {"height": made.height, "width": made.width, "step": 3 * made.width}
            image = store.types[kinds["/cam/image_raw"]](
                header=head, encoding="bgr8", is_bigendian=0, data=pixels.ravel(), **size
            )
            for k, (name, message) in enumerate([("/cam/camera_info", made), ("/cam/image_raw", image)]):
                writer.write(to[name], int((100 + i) * 1e9) + k, store.serialize_cdr(message, kinds[name]))
    return path


def test_a_camera_info_of_zeros_is_none(tmp_path):
    """As drivers without a calibration send it."""
    camera = PinholeCamera(50, 50, 32, 24, 64, 48)
    zeros = {"k": np.zeros(9), "p": np.zeros(12)}
    stream = open_stream(write_ramps(tmp_path / "a", [(zeros, 1)] * 3), camera=camera)
    assert stream.camera == camera
    assert "/cam/camera_info has zeros" in dict(stream.notes)["no CameraInfo"]
    for frame in stream:
        np.testing.assert_array_equal(frame.image, ramp(64, 48, 1))


def test_another_camera_ends_the_stream(tmp_path):
    """Zeros say nothing; another focal length makes other images."""
    other, zeros = {"k": np.array([80.0, 0, 64, 0, 82, 48, 0, 0, 1])}, {"k": np.zeros(9), "d": np.zeros(5)}
    stream, images = open_stream(write_ramps(tmp_path / "a", [({}, 1), (zeros, 1), (other, 0.5), ({}, 1)])), []
    with pytest.raises(SourceError, match="breaks off after 2 images: /cam/camera_info gives another camera"):
        images += (frame.image for frame in stream)
    for image in images:
        np.testing.assert_array_equal(image, ramp(64, 48, 1))
    assert len(images) == 2


@pytest.mark.parametrize(
    ("change", "topic", "match"),
    [
        ({"k": np.zeros(9)}, "/cam/image_raw", "K is zero"),
        ({"p": np.zeros(12)}, "/cam/image_rect", "P is zero"),
        ({"distortion_model": "equidistant", "d": np.ones(4)}, "/cam/image_raw", "of 4 numbers.* undistort"),
        ({"distortion_model": "kannala_brandt4", "d": np.zeros(0)}, "/cam/image_raw", "of 0 numbers"),
        ({"width": 0}, "/cam/image_raw", "width = 0"),
    ],
)
def test_a_camera_info_that_says_no_camera_is_refused(change, topic, match):
    message = info()
    vars(message).update(change)
    with pytest.raises(SourceError, match=match):
        camera_of_info(message, "info", topic)


@pytest.mark.parametrize("stamped", [True, False])
def test_times_are_those_of_the_headers_else_of_reception(tmp_path, stamped):
    stamps = (50.0 + np.arange(6)) * stamped
    stream = open_stream(write_bag(tmp_path / "a", "sqlite", image_options={"header_times": stamps}))
    times = stamps if stamped else 100 + np.arange(6)  # a second apart
    np.testing.assert_allclose([frame.timestamp_s for frame in stream], times, atol=2e-3)
    assert ("no header stamps" in dict(stream.notes)) is (not stamped)


# decoding ahead


@dataclass
class Slow:
    """A stream whose frames take a while, and which may break off."""

    n: int = 20
    pause: float = 0.0
    live: bool = False
    fail: bool = False
    name: str = "slow"
    camera: None = None
    n_frames: None = None

    def __iter__(self):
        for i in range(self.n):
            time.sleep(self.pause)
            yield Frame(str(i), 0.05 * i, np.zeros((2, 2, 3), np.uint8))
        if self.fail:
            raise SourceError("gone")


def test_all_frames_come_in_order_and_the_error_after_them():
    seen, frames = [], prefetch(Slow(fail=True))

    def take():
        for frame in frames:
            seen.append(frame.name)
            time.sleep(0.002)

    with pytest.raises(SourceError, match="gone"):
        take()
    assert seen == [str(i) for i in range(20)]


def test_a_live_source_loses_the_oldest_frames_of_a_slow_taker():
    seen = []
    for frame in prefetch(Slow(n=40, pause=0.005, live=True), depth=2):
        seen.append(int(frame.name))
        time.sleep(0.03)
    assert seen == sorted(seen)
    assert seen[-1] == 39
    assert len(seen) < 25


def test_a_data_set_streams_the_frames_between_too(redkitchen):
    sequence = read_recording(redkitchen)
    stream = open_stream(redkitchen)
    assert isinstance(stream, RecordingStream)
    some = RecordingStream(sequence, np.array([3, 5, 8]))
    frames = list(some)
    assert [(f.index, f.answer) for f in frames] == [(i, i in (3, 5, 8)) for i in range(3, 9)]
    assert some.n_frames == 6
    np.testing.assert_array_equal(frames[2].image, sequence.image(5))
    with pytest.raises(DatasetError, match="no such file or folder"):
        open_stream(redkitchen / "absent")


def cut_off(root):
    (path,) = write_bag(root / "bag", "mcap").glob("*.mcap")
    (root / "a.mcap").write_bytes(path.read_bytes()[:-200])


def mcap(root, *, profile="", encoding="json", schema="foxglove.CompressedImage", chunked=False, summary=False):
    """An MCAP file with a channel and no message, written after its specification."""

    def text(value):
        return struct.pack("<I", len(value)) + value.encode()

    def record(code, content):
        return bytes([code]) + struct.pack("<Q", len(content)) + content

    magic, header = b"\x89MCAP0\r\n", record(1, text(profile) + text("app"))
    described = record(3, struct.pack("<H", 1) + text(schema) + text("jsonschema") + text("{}"))
    described += record(4, struct.pack("<HH", 1, 1) + text("/camera") + text(encoding) + struct.pack("<I", 0))
    inside = described + record(5, bytes(22) + b"{}")
    if chunked:
        inside = record(6, bytes(28) + text("" if not summary else "zstd") + struct.pack("<Q", len(inside)) + inside)
    data = magic + header + inside + record(15, bytes(4))
    footer = record(2, struct.pack("<QQI", len(data) if summary else 0, 0, 0))
    (root / "a.mcap").write_bytes(data + (described if summary else b"") + footer + magic)


FOXGLOVE = r"not of ROS: foxglove.CompressedImage as json on /camera; record them as ROS messages"


def put(content):
    return lambda root: (root / "a").write_bytes(content)


def put_bag(**options):
    return lambda root: write_bag(root / "a", "sqlite", **options)


SMALL = PinholeCamera(40, 40, 16, 12, 32, 24)
IMU = [("/imu", "sensor_msgs/msg/Imu")]
REFUSED = {  # what is written, what is opened, how, and what is told
    "no video": (put(b"nothing"), "a", {}, "cannot be opened as a video"),
    "a list": (put(b"ffconcat version 1.0\nfile 'v.mp4'\n"), "a", {}, "list of other files"),
    "a video of another camera": (lambda root: video(root / "a.avi"), "a.avi", {"camera": SMALL}, "64x48"),
    "a packed bag": (lambda root: (root / "a.db3.zstd").write_bytes(b"x"), "a.db3.zstd", {}, "unpack it"),
    "a bag that was not closed": (cut_off, "a.mcap", {}, "mcap recover"),
    "Foxglove's messages": (mcap, "a.mcap", {}, FOXGLOVE),
    "Foxglove's messages in a chunk": (partial(mcap, chunked=True), "a.mcap", {}, FOXGLOVE),
    "Foxglove's messages in packed chunks": (partial(mcap, chunked=True, summary=True), "a.mcap", {}, FOXGLOVE),
    "protobuf": (partial(mcap, encoding="protobuf"), "a.mcap", {}, "foxglove.CompressedImage as protobuf on /camera"),
    "messages of ROS without its profile": (
        partial(mcap, encoding="cdr", schema="sensor_msgs/msg/Image"),
        "a.mcap",
        {},
        "its profile is '', expected ros1 or ros2; 'ros2 bag convert' writes it anew",
    ),
    "text for a bag": (lambda root: (root / "a.bag").write_bytes(b"<html>"), "a.bag", {}, "begins with b'<html>'"),
    "an archive of bags": (lambda root: (root / "a.mcap").write_bytes(b"PK\3\4..."), "a.mcap", {}, "is an archive"),
    "a bag without images": (put_bag(topic=None, others=IMU), "a", {}, "its topics are /imu"),
    "an encoding": (put_bag(image_options={"encoding": "jpeg2000"}), "a", {}, "encoding jpeg2000"),
    "a film": (put_bag(image_options={"compressed": True, "form": "h264"}), "a", {}, "h264"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_opened_is_named(tmp_path, monkeypatch, what):
    write, source, options, told = REFUSED[what]
    write(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SourceError, match=told) as error:
        list(open_stream(source, **options))
    assert source in str(error.value)


def test_every_damaged_mcap_is_described(tmp_path):
    mcap(tmp_path, chunked=True, summary=True)
    whole, rng = (tmp_path / "a.mcap").read_bytes(), np.random.default_rng(0)
    for _ in range(300):
        content = bytearray(whole)
        for at in rng.integers(8, len(whole), 3).tolist():
            content[at] = int(rng.choice([0, 1, 8, 127, 255]))
        (tmp_path / "a.mcap").write_bytes(content[: rng.integers(9, len(whole) + 1)])
        assert isinstance(describe_unopened(tmp_path / "a.mcap"), str)


def test_files_of_one_name_in_two_recordings_are_told_apart(tmp_path, monkeypatch):
    here, there = tmp_path / "seq-01" / "a.png", tmp_path / "seq-02" / "a.png"
    assert frame_names([here, tmp_path / "seq-01" / "b.png"]) == ["a.png", "b.png"]
    assert frame_names([here, there]) == ["seq-01/a.png", "seq-02/a.png"]
    monkeypatch.chdir(tmp_path)
    assert frame_names([here.relative_to(tmp_path), there]) == ["seq-01/a.png", "seq-02/a.png"]
    assert frame_names([here, here]) == ["a.png", "a.png"]


def test_a_live_camera_is_stamped_by_a_clock_that_is_not_set(monkeypatch):
    wall, steady = iter([100.0, 99.5, 99.4]), iter([5.0, 5.0, 5.1])
    monkeypatch.setattr("conformodal.io.streams.video.time.time", lambda: next(wall))
    monkeypatch.setattr("conformodal.io.streams.video.time.monotonic", lambda: next(steady))
    monkeypatch.setattr("conformodal.io.streams.video.cv2.VideoCapture", Device)
    stamps = [frame.timestamp_s for frame in islice(CameraStream(0), 2)]
    assert stamps == pytest.approx([100.0, 100.1])


class Device:
    """A camera that never ends."""

    def __init__(self, index):
        pass

    def isOpened(self):
        return True

    def read(self):
        return True, np.zeros((4, 4, 3), np.uint8)

    def release(self):
        pass
