"""A small model of all parts, made of numbers in milliseconds instead of trained; its answers mean nothing."""

from functools import cache

import numpy as np
import onnx
from onnx import TensorProto, helper

from conformodal.conformal import NoveltyTest, QuantileBins, SplitConformal
from conformodal.features.backbone import INPUT, OUTPUT, Backbone, BackboneConfig, at_unit_length
from conformodal.features.export import IR_VERSION, OPSET
from conformodal.features.head import Head, Projection
from conformodal.features.local import ORB, QualityRange, extract_local_features
from conformodal.geometry import PinholeCamera
from conformodal.io import Split
from conformodal.localizer.evidence import ErrorModel, FrameEvidence
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.observations import MotionPrior
from conformodal.localizer.regions import PlaceNovelty, RegionRules
from conformodal.localizer.rooms import Rooms
from conformodal.localizer.sources.head import HeadSource
from conformodal.localizer.sources.landmark_map import LandmarkMap
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.localizer.sources.neighbours import LocalRegression, LocalSettings, NeighbourSource
from conformodal.pipeline.identity import FrameIdentities
from conformodal.pipeline.model import PATHS, ExpectedInput, PathRule, PoseModel, SourceComparison, path_rule

CAMERA = PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120, (0.01, -0.01, 0.0, 0.0))
_FRAMES = np.arange(12)
_HIDDEN, _BINS, _DEPTH_M = 4, 4, 3.0


def image():
    """An image with corners, of which the model's map has landmarks."""
    squares = np.random.default_rng(3).integers(0, 256, (3, 4, 3)).astype(np.uint8)
    return np.kron(squares, np.ones((40, 40, 1), np.uint8))


@cache
def backbone():
    """The mean colours of 4 x 4 parts of an image."""
    nodes = [
        helper.make_node("Cast", [INPUT], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["numbers"], ["first"], perm=[0, 3, 1, 2]),
        helper.make_node("AveragePool", ["first"], ["means"], kernel_shape=[6, 8], strides=[6, 8]),
        helper.make_node("Flatten", ["means"], [OUTPUT]),
    ]
    images = helper.make_tensor_value_info(INPUT, TensorProto.UINT8, ["n", 24, 32, 3])
    features = helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["n", 48])
    graph = helper.make_graph(nodes, "colours", [images], [features])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    onnx.checker.check_model(model)
    return Backbone(BackboneConfig("colours", None, 32, 24, (4, 4)), model.SerializeToString())


def small_model(detector=ORB):
    """A model with all sources and evidence types, whose regions and paths whole stretches calibrate."""
    rng, network = np.random.default_rng(0), backbone()
    features = network.features_of(image()) + rng.normal(0, 0.5, (20, network.n_features)).astype(np.float32)
    targets = np.column_stack((rng.normal(size=(20, 3)), np.ones(20), rng.normal(0, 0.1, (20, 3))))
    targets[:, 3:] /= np.linalg.norm(targets[:, 3:], axis=1, keepdims=True)
    bins = QuantileBins(_BINS, 0.02).fit(targets)
    sources = _head(rng, features, sum(bins.sizes)), _neighbours(rng, features, targets), _landmarks(features, detector)
    localizer = Localizer((*sources,), bins, np.array([1.0, 0, 0, 0]), _DEPTH_M)

    labels = np.repeat(np.arange(20), 3)
    overall = SplitConformal(localizer.cells, 0.2, "density", "max").set_scale(rng.uniform(1, 2, 7), rng.normal(size=7))
    overall.calibrate_scores(rng.normal(size=(60, 7)), labels)
    disturbed = overall.at(0.2).calibrate_scores(rng.normal(size=(30, 7)), labels[:30])
    rules = RegionRules(overall, np.arange(60) % 2 == 0, rng.random(60), 0.1, disturbed, rng.random(30), labels % 2)
    coarse = FrameEvidence(features[_FRAMES]).coarse(network.config.grid).astype(np.float16)
    test = NoveltyTest(coarse, _FRAMES // 2)
    novelty = PlaceNovelty(test, network.config.grid, test.rescored(rng.normal(size=60), labels))
    paths = {}
    for path in PATHS:
        scores = np.repeat(rng.random((60, 1)), 7, axis=1)
        calibration = path_rule(localizer.cells, 0.2).calibrate_scores(scores, labels, np.full(60, 3))
        paths[path] = PathRule(calibration, 0.2, rng.chisquare(6, 60), (labels % 3) / 2, 0.1, labels % 2)
    return PoseModel(
        backbone=network,
        localizer=localizer,
        novelty=novelty,
        rules=rules,
        prior=MotionPrior(0.5, (0.1, 0.2), (1.0, 0.9), (0.2, 0.1), _DEPTH_M, 0.3, 20.0),
        camera=CAMERA,
        detector=detector,
        split=Split("blocks", 0, _FRAMES, np.arange(12, 16), np.arange(16, 20)),
        known_frames=FrameIdentities(rng.integers(0, 256, (20, 16)).astype(np.uint8), targets),
        expected_input=ExpectedInput(0.1, np.full(21, 1 / 21)),
        configuration={"method": "conformodal", "data": "numbers", "unit": "m", "features": detector.name},
        comparison=SourceComparison(100, 80, 3, 4, 0.5),
        path_rules=paths,
        rooms=Rooms(targets[:, :3], np.arange(20) % 2),
        quality=QualityRange(np.zeros(3), np.array([255.0, 255.0, 255.0])),
    )


def _head(rng, features, n_outputs):
    shapes = {"components": (features.shape[1], 3), "hidden.weight": (_HIDDEN, 3), "hidden.bias": (_HIDDEN,)}
    shapes |= {"norm.weight": (_HIDDEN,), "norm.bias": (_HIDDEN,), "output.weight": (n_outputs, _HIDDEN)}
    weights = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    weights |= {"offset": features.mean(axis=0), "output.bias": np.zeros(n_outputs, np.float32)}
    weights["components"] = _in_half_precision(weights["components"])
    return HeadSource(Head(weights, [n_outputs // 7] * 7), _FRAMES)


def _in_half_precision(components):
    """As those of a fit are, so that they are stored as such."""
    return components.astype(np.float16).astype(np.float32)


def _neighbours(rng, features, targets):
    components = _in_half_precision(rng.normal(size=(features.shape[1], 3)))
    projection = Projection(features.mean(axis=0), components)
    references, scale = projection.apply(features[_FRAMES]), np.ones(7)
    regression = LocalRegression(projection, references, targets[_FRAMES], scale, LocalSettings(3, 4, 0.03, 0.5))
    errors = ErrorModel(0.1, 1.0, 0.0, 0.1, 1.0, 0.0, 1.0, (0.5,))
    return NeighbourSource(regression, _FRAMES, 1.0, 2.0, errors, 0.05)


def _landmarks(features, detector):
    """The corners of the image at depths of two to four metres, known from three keyframes."""
    local, camera = extract_local_features(image(), CAMERA, detector), PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120)
    depths = np.random.default_rng(1).uniform(2, 4, (len(local.pixels), 1))
    points = np.column_stack((camera.on_plane(local.pixels), np.ones(len(depths)))) * depths
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 0, 0.2, 0.4
    mapped = LandmarkMap(
        camera,
        np.eye(4),
        np.zeros(2),
        np.zeros(3),
        poses,
        at_unit_length(FrameEvidence(features[:3]).coarse((4, 4))).astype(np.float16),
        np.arange(4) * len(points),
        np.tile(points, (3, 1)).astype(np.float32),
        np.tile(local.descriptors, (3, 1)),
        np.zeros((3, 6)),
        3.0,
    )
    errors = ErrorModel(1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0, (0.5, 0.5, 0.5))
    held_out = np.random.default_rng(2).random((30, 9))
    return LandmarkSource(mapped, _FRAMES, errors, (4, 4), held_out)
