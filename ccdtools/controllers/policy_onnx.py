"""Policies as ONNX models, out and in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, frozen
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_finite, as_floats, as_instance, brief
from learning.networks import Layers

OPSET = 17  # of ONNX 1.12, from July 2022
DESIGN = "ccdtools.design"  # metadata of a policy at a design


def write_onnx(
    layers: Layers, centre: Array, width: Array, action_range: tuple[Array, Array], design: Array, path: Path
) -> Path:  # fmt: skip
    """Path of an ONNX model, written for layers in normalised states."""
    onnx = _installed("onnx")
    helper, numpy_helper = onnx.helper, onnx.numpy_helper
    numbers: list[Any] = []
    nodes: list[Any] = []

    def put(operator: str, *inputs: str | Array) -> str:
        """Name of the result of one more node."""
        names = []
        for value in inputs:
            if isinstance(value, str):
                names.append(value)
            else:
                numbers.append(numpy_helper.from_array(np.asarray(value, float), f"number{len(numbers)}"))
                names.append(numbers[-1].name)
        nodes.append(helper.make_node(operator, names, [f"value{len(nodes)}"]))
        return f"value{len(nodes) - 1}"

    z = put("Div", put("Sub", "x", centre), width)
    h = z
    for k, (W, b) in enumerate(layers.maps):
        h = put("Add", put("MatMul", h, W), b)
        h = put("Tanh", h) if k < len(layers.maps) - 1 else h
    if layers.skip is not None:
        h = put("Add", h, put("Add", put("MatMul", z, layers.skip[0]), layers.skip[1]))
    middle, half = action_range
    put("Add", put("Mul", put("Clip", h, np.array(-1.0), np.array(1.0)), half), middle)
    nodes[-1].output[0] = "u"
    kind = onnx.TensorProto.DOUBLE
    ends = [helper.make_tensor_value_info(name, kind, ["n", m]) for name, m in (("x", len(centre)), ("u", len(middle)))]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], numbers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = 8
    helper.set_model_props(model, {DESIGN: json.dumps(design.tolist())})
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))
    return path


class OnnxPolicy:
    """Controller of an ONNX model with one input and one output, states to inputs.

    Parameters
    ----------
    path : path
        Of the model: rows of states (n, nx) in, rows of inputs (n, nu) out, in single or double precision; n is free,
        or one. Copies read the file again.

    Attributes
    ----------
    design : (np,) array or None
        That of the policy which wrote the file, the only one at which it is simulated; None of other models.

    Raises
    ------
    InputError
        If onnxruntime is not installed, or the file is no such model or has operators that it does not know; when it is
        called, if the model does not take the states or gives no row for each.
    """

    def __init__(self, path: str | Path) -> None:
        as_instance("path", path, (str, Path), "the path of an ONNX model")
        runtime = _installed("onnxruntime")
        if not Path(path).is_file():
            raise InputError("path", repr(str(path)), "a file")
        try:
            self._session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        except Exception as error:  # the runtime's own errors have no common base but this
            reason = brief(str(error).partition("\n")[0].rpartition(" failed:")[2], 300)  # it begins with the path
            raise InputError("path", reason, "an ONNX model that onnxruntime can run") from None
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        kinds = {"tensor(double)": np.float64, "tensor(float)": np.float32}
        one_each = len(inputs) == len(outputs) == 1 and {inputs[0].type, outputs[0].type} <= set(kinds)
        shape = inputs[0].shape if one_each else []
        if len(shape) != 2 or (isinstance(shape[0], int) and shape[0] != 1):
            got = " and ".join(str([(one.shape, one.type) for one in ends]) for ends in (inputs, outputs))
            raise InputError("path", brief(got), "one input (n, nx), n free or 1, and one output, of float or double")
        design = self._session.get_modelmeta().custom_metadata_map.get(DESIGN)
        self.design = None if design is None else frozen(np.array(json.loads(design), float))
        self._path = Path(path).resolve()
        self._kind = kinds[inputs[0].type]
        self._input = inputs[0].name
        self._rows, self._nx = shape

    def as_given(self) -> tuple[bytes]:
        """What the file holds, wherever it lies."""
        return (self._path.read_bytes(),)

    def __reduce__(self) -> tuple[type[OnnxPolicy], tuple[Path]]:
        return OnnxPolicy, (self._path,)

    def __repr__(self) -> str:
        return f"OnnxPolicy({str(self._path)!r})"

    def __call__(self, x: ArrayLike) -> Array:
        """Inputs (n, nu) or (nu,)."""
        x = as_finite("x", as_floats("x", x))
        rows = np.atleast_2d(x).astype(self._kind)
        if x.ndim not in (1, 2) or (isinstance(self._nx, int) and rows.shape[1] != self._nx):
            raise InputError("x", f"shape {x.shape}", f"({self._nx},) or (n, {self._nx})")
        u = np.concatenate([self._of(part) for part in (rows[:, None] if self._rows == 1 else rows[None])])
        return u if x.ndim == 2 else u[0]

    def _of(self, rows: Array) -> Array:
        """Inputs (n, nu) of one run of the model."""
        try:
            u = np.asarray(self._session.run(None, {self._input: rows})[0], float)
        except Exception as error:  # as above
            reason = brief(str(error).partition("\n")[0])
            raise InputError("x", f"shape {rows.shape}: {reason}", "states that the model takes") from None
        if u.ndim == 0 or len(u) != len(rows):
            raise InputError("path", f"a model that gives {u.shape} for {rows.shape}", f"inputs ({len(rows)}, nu)")
        return u.reshape(len(u), int(np.prod(u.shape[1:])))


def _installed(package: str) -> Any:
    """Package of the extra `onnx`."""
    try:
        return __import__(package)
    except ImportError:
        raise InputError(package, "no such package", "it installed: pip install ccdtools[onnx]") from None
