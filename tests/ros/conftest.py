"""Estimates made by hand, and a stand-in for rclpy and tf2_ros."""

import sys
from array import array
from functools import partial
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from conformodal.conformal import QuantileBins
from conformodal.geometry import Pose
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.estimates import Estimate
from tests.helpers import pose_regions_of


def random_candidates(rng, m=4):
    quats = rng.normal(size=(m, 4))
    mass = rng.dirichlet(np.ones(m))
    order = np.argsort(-mass)
    return PoseMixture.weighted(
        np.clip(rng.normal(size=(m, 3)), -2.9, 2.9),
        rng.uniform(0.05, 0.5, (m, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(0.01, 0.1, m),
        np.log(mass[order]),
    )


def some_region(rng, found, n_bins=12, unbounded=False):
    """Of one frame: 12 bins of half a metre an axis, some of them in the set; of these, what candidates support."""
    edges = [np.linspace(-3, 3, n_bins + 1)] * 3 + [np.linspace(-1, 1, n_bins + 1)] * 4
    masks = [rng.random((1, n_bins)) < 0.8 for _ in edges]
    quat = np.sign(found.orientations_quat_wxyz[0, 0]) * found.orientations_quat_wxyz[0]
    for mask, its, value in zip(masks, edges, (*np.clip(found.positions_xyz[0], -2.9, 2.9), *quat), strict=True):
        mask[0, np.searchsorted(its, value) - 1] = True  # the most probable one supports a box
    return pose_regions_of(QuantileBins.from_edges(edges), masks, np.full((1, 7), unbounded), [found])


@pytest.fixture
def some_candidates():
    return random_candidates


@pytest.fixture
def make_estimate():
    """Gives an estimate at a time; `kind` None is a frame without an image."""

    def make(time_s=1.5, kind=EvidenceType.GLOBAL, seed=0, revised=None, candidates=None, region=None, **given):
        if kind is None:
            return Estimate(time_s, None, None, None, None, False, "no image")
        rng = np.random.default_rng(seed)
        found = random_candidates(rng) if candidates is None else candidates
        chosen = found if revised is None else revised[-1:]
        pose = Pose(chosen.positions_xyz[0], chosen.orientations_quat_wxyz[0])
        unknown = kind is EvidenceType.UNKNOWN
        given = {"position_spread_m": 0.3, "orientation_spread_rad": 0.05, "known_p": 0.5, **given}
        return Estimate(
            time_s,
            pose,
            some_region(rng, found, unbounded=unknown) if region is None else region,
            found,
            None,
            not unknown,
            "like no place that is known" if unknown else "",
            evidence=kind,
            revise=None if revised is None else lambda: revised,
            **given,
        )

    return make


BASES = {"string": str, "bool": bool, "float32": float, "float64": float, "byte": bytes}
CODES = {"float64": "d", "float32": "f", "uint8": "B", "byte": "B"}


class Messages:
    """Classes of messages, made from the definitions that rosbags has, as strict about what they get as ROS's own."""

    def __init__(self):
        from rosbags.typesys import Stores, get_typestore

        self.store, self.classes = get_typestore(Stores.ROS2_JAZZY), {}

    def of(self, kind):
        if kind not in self.classes:
            fields = self.store.fielddefs[kind][1]

            def construct(this, **given):
                assert set(given) <= {name for name, _ in fields}, given
                for name, (node, what) in fields:
                    assert name not in given or self.fits(given[name], int(node), what), (name, given[name], what)
                    setattr(this, name, given[name] if name in given else self.default(int(node), what))

            self.classes[kind] = type(kind.rpartition("/")[2], (), {"__init__": construct})
        return self.classes[kind]

    def default(self, node, what):
        if node == 1:
            return b"\0" if what[0] == "byte" else BASES.get(what[0], int)()
        if node == 2:
            return self.of(what)()
        (of, name), length = what
        if node == 3:
            return np.zeros(length)
        return [] if int(of) == 2 or name[0] == "string" else array(CODES[name[0]])

    def fits(self, value, node, what):
        if node == 1:
            return type(value) is BASES.get(what[0], int)
        if node == 2:
            return type(value) is self.of(what)
        (of, name), length = what
        if int(of) == 2:
            return isinstance(value, list) and all(type(item) is self.of(name) for item in value)
        if node == 3:
            return isinstance(value, np.ndarray) and (value.dtype, value.shape) == (np.float64, (length,))
        return isinstance(value, array) and value.typecode == CODES[name[0]]


class Node:
    """What the node asks of rclpy's."""

    def __init__(self, given):
        self.given, self.declared = given, []
        self.now_ns, self.said, self.logged, self.subscribed, self.destroyed = 0, [], [], {}, False
        self.timers = {}

    def declare_parameter(self, name, default):
        self.declared.append(name)
        return SimpleNamespace(value=self.given.get(name, default))

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.said.append((topic, message)))

    def create_subscription(self, kind, topic, callback, profile):
        assert profile == (10 if topic == "initialpose" else "sensor data")
        self.subscribed[topic] = (kind, callback)

    def create_timer(self, period_s, callback):
        self.timers[callback.__name__] = (period_s, callback)

    def get_logger(self):
        return SimpleNamespace(**{level: partial(self.log, level) for level in ("info", "warning", "error")})

    def log(self, level, text):
        self.logged.append((level, text))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now_ns))

    def destroy_node(self):
        self.destroyed = True


class TransformException(Exception):
    pass


class Buffer:
    """Transforms by hand: a chain of frames, each with samples over time in its parent, or one that always holds."""

    def __init__(self):
        self.parents, self.waited_s = {}, []

    def set(self, parent, child, T, stamp_ns=None):
        known = self.parents.setdefault(child, (parent, {}))
        assert known[0] == parent
        known[1][stamp_ns] = np.asarray(T, dtype=float)

    def set_message(self, message, static):
        at, q = message.transform.translation, message.transform.rotation
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [at.x, at.y, at.z]
        stamp = message.header.stamp
        stamp_ns = None if static else stamp.sec * 1_000_000_000 + stamp.nanosec
        self.set(message.header.frame_id, message.child_frame_id, T, stamp_ns)

    def clear(self):
        self.parents = {child: known for child, known in self.parents.items() if None in known[1]}

    def chain(self, frame):
        """The frame and those above it."""
        while frame:
            yield frame
            frame, _ = self.parents.get(frame, (None, None))

    def up(self, frame, ancestor, stamp_ns):
        """``T_ancestor_frame``."""
        if frame == ancestor:
            return np.eye(4)
        parent, samples = self.parents[frame]
        return self.up(parent, ancestor, stamp_ns) @ self.between(samples, stamp_ns)

    def between(self, samples, stamp_ns):
        if None in samples:
            return samples[None]
        times = sorted(samples)
        stamp_ns = stamp_ns or times[-1]
        if not times[0] <= stamp_ns <= times[-1]:
            raise TransformException("extrapolation")
        if len(times) == 1:
            return samples[times[0]]
        seconds, poses = 1e-9 * (np.array(times) - times[0]), np.array([samples[t] for t in times])
        now, T = 1e-9 * (stamp_ns - times[0]), np.eye(4)
        T[:3, :3] = Slerp(seconds, Rotation.from_matrix(poses[:, :3, :3]))(now).as_matrix()
        T[:3, 3] = [np.interp(now, seconds, column) for column in poses[:, :3, 3].T]
        return T

    def matrix(self, target, source, stamp_ns):
        above = list(self.chain(target))
        common = next((frame for frame in self.chain(source) if frame in above), None)
        if common is None:
            raise TransformException("not connected")
        return np.linalg.inv(self.up(target, common, stamp_ns)) @ self.up(source, common, stamp_ns)

    def can_transform(self, target, source, time):
        try:
            self.matrix(target, source, time.nanoseconds)
        except TransformException:
            return False
        return True

    def lookup_transform(self, target, source, time, timeout):
        self.waited_s.append(timeout.seconds)
        T = self.matrix(target, source, time.nanoseconds)
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        rotation = SimpleNamespace(x=x, y=y, z=z, w=w)
        return SimpleNamespace(
            transform=SimpleNamespace(
                translation=SimpleNamespace(**dict(zip("xyz", T[:3, 3], strict=True))), rotation=rotation
            )
        )


@pytest.fixture
def transforms():
    """A buffer of transforms."""
    return Buffer()


def stand_in_for_tf2(monkeypatch, found):
    """tf2_ros, whose buffer is `found.buffer`; transforms that are sent are there again, as said on /tf."""
    found.buffer = Buffer()
    tf2, time, duration = ModuleType("tf2_ros"), ModuleType("rclpy.time"), ModuleType("rclpy.duration")
    tf2.Buffer, tf2.TransformException = lambda: found.buffer, TransformException

    def listener(buffer, node):
        assert buffer is found.buffer

    def broadcaster(node):
        return SimpleNamespace(sendTransform=lambda message: node.said.append(("/tf", message)))

    tf2.TransformListener, tf2.TransformBroadcaster = listener, broadcaster
    time.Time = lambda nanoseconds=0: SimpleNamespace(nanoseconds=nanoseconds)
    duration.Duration = lambda seconds: SimpleNamespace(seconds=seconds)
    for module in (tf2, time, duration):
        monkeypatch.setitem(sys.modules, module.__name__, module)


@pytest.fixture
def ros(monkeypatch):
    """A stand-in for rclpy and the packages of messages; `given` are parameters, `spin` what happens meanwhile."""
    messages = Messages()
    found = SimpleNamespace(messages=messages, make_node=Node, given={}, spin=lambda node: None, node=None, ended=0)

    class Package(ModuleType):
        def __getattr__(self, name):
            if name.startswith("__"):
                raise AttributeError(name)
            return messages.of(f"{self.__name__.removesuffix('.msg')}/msg/{name}")

    for package in {name.split("/")[0] for name in messages.store.fielddefs}:
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", Package(f"{package}.msg"))

    def create_node(name):
        assert name == "conformodal"
        found.node = Node(found.given)
        return found.node

    def try_shutdown():
        found.ended += 1

    def spin(node, executor):  # tests set it later
        assert executor.num_threads > 1  # transforms come while an image is answered
        found.spin(node)

    rclpy, executors, qos = ModuleType("rclpy"), ModuleType("rclpy.executors"), ModuleType("rclpy.qos")
    rclpy.init, rclpy.create_node, rclpy.try_shutdown = lambda args: None, create_node, try_shutdown
    rclpy.spin = spin
    executors.MultiThreadedExecutor = lambda num_threads: SimpleNamespace(num_threads=num_threads)
    executors.ExternalShutdownException = type("ExternalShutdownException", (Exception,), {})
    qos.qos_profile_sensor_data = "sensor data"
    for module in (rclpy, executors, qos):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    stand_in_for_tf2(monkeypatch, found)
    return found
