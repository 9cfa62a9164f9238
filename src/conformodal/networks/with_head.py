"""One ONNX file from image to probabilities, for programs other than this one."""

from __future__ import annotations

from typing import Any

import numpy as np

from conformodal.core import needing
from conformodal.vision import OnnxBackbone, SoftmaxHead
from conformodal.vision.onnx_backbone import OUTPUT


def with_head(backbone: OnnxBackbone, head: SoftmaxHead, targets: tuple[str, ...]) -> bytes:
    """The network and its softmax head: input ``images`` as the network's, outputs ``map`` and one (n, K) a target.

    Parameters
    ----------
    backbone, head
        Of one model.
    targets
        Names of the outputs, one a target.

    Raises
    ------
    MissingPackageError
        If the package onnx is not installed.
    """
    with needing("train", "the export of a network"):
        import onnx  # noqa: PLC0415 - only here
        from onnx import helper, numpy_helper  # noqa: PLC0415

    model = onnx.load_model_from_string(backbone.content)
    graph = model.graph
    n_map = backbone.maps(np.zeros((1, backbone.config.height, backbone.config.width, 3), np.uint8)).shape[1]
    ours = {name: np.asarray(value) for name, value in head.weights.items()}
    # the head does not see the global descriptor, in which features end
    ours["offset"], ours["components"] = ours["offset"][:n_map], ours["components"][:n_map]
    if ours["components"].ndim == 1:  # then the hidden layer looks at all features, and those of the descriptor are 0
        ours["trunk.1.weight"] = ours["trunk.1.weight"][:, :n_map]
    for name in ("trunk.1.weight", "output.weight"):
        ours[name] = np.ascontiguousarray(ours[name].T)
    ours |= {k: np.array(v, np.float32) for k, v in (("half", 0.5), ("one", 1), ("root", np.sqrt(0.5)))}
    graph.initializer.extend(numpy_helper.from_array(value, f"head.{name}") for name, value in ours.items())

    def add(operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        graph.node.append(helper.make_node(operator, inputs, [f"head.{output}"], **attributes))
        return f"head.{output}"

    last = add("Cast", [OUTPUT], "rounded", to=onnx.TensorProto.FLOAT16)  # as features are kept
    last = add("Cast", [last], "features", to=onnx.TensorProto.FLOAT)
    last = add("Sub", [last, "head.offset"], "centred")
    last = add("MatMul" if ours["components"].ndim == 2 else "Mul", [last, "head.components"], "projected")
    last = add("MatMul", [last, "head.trunk.1.weight"], "hidden")
    last = add("Add", [last, "head.trunk.1.bias"], "shifted")
    normalised = [last, "head.trunk.2.weight", "head.trunk.2.bias"]
    last = add("LayerNormalization", normalised, "normalised", axis=-1, epsilon=1e-5)
    inner = add("Mul", [last, "head.root"], "scaled")
    inner = add("Add", [add("Erf", [inner], "erf"), "head.one"], "erf1")
    last = add("Mul", [add("Mul", [last, "head.half"], "halved"), inner], "gelu")
    last = add("MatMul", [last, "head.output.weight"], "product")
    last = add("Add", [last, "head.output.bias"], "raw")
    start = 0
    for target, size in zip(targets, head.outputs, strict=True):
        for name, value in (("from", start), ("to", start + size)):
            graph.initializer.append(numpy_helper.from_array(np.array([value], np.int64), f"head.{target}.{name}"))
        block = add("Slice", [last, f"head.{target}.from", f"head.{target}.to", "head.axis"], f"{target}.raw")
        graph.node.append(helper.make_node("Softmax", [block], [target], axis=1))
        graph.output.append(helper.make_tensor_value_info(target, onnx.TensorProto.FLOAT, ["n", size]))
        start += size
    graph.initializer.append(numpy_helper.from_array(np.array([1], np.int64), "head.axis"))
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())
