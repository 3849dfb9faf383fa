"""Trained networks: ONNX files, read and run by OpenVINO on one CPU thread.

A file holds the network's layers and weights, and in its metadata the network's name and the facts of its training
(data, seed, metrics).  Any viewer of ONNX opens it; `training.common.weight_file` writes it.  Its last bytes are a hash
of all before them, the value of the last metadata entry: a file that was cut or changed is refused before it is parsed.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from runtime.errors import InputRefused

SHIPPED: Final = Path(__file__).parent / "weights"
"""Folder of the weights that are shipped with the package, NAME.onnx beside its card NAME.md."""
PRECISIONS: Final = ("f32", "bf16")
DIGEST_BYTES: Final = 64


@dataclass(frozen=True, slots=True)
class Interface:
    """What a network's reader relies on: its name, the channels of its input and of each output.  Tensors are NCHW."""

    name: str
    channels: int
    outputs: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Weights:
    """A network as it was read: ``model`` is an openvino.Model for pictures of any size."""

    interface: Interface
    model: Any
    facts: dict[str, str]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the trained arrays as float32, by their names in training."""
        return {name: data.astype(np.float32) for name, data in _constants(self.model) if _is_trained(name)}


def digest(body: bytes) -> bytes:
    """Compute what a weight file ends with after ``body``."""
    return hashlib.sha256(body).hexdigest().encode()


def load(path: Path, interface: Interface) -> Weights:
    """Load the network of a weight file.

    Raises:
        InputRefused: the file is missing, damaged, or of another network.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputRefused("weights.missing", f"{path}: no such weight file; `timberhand train` makes one") from None
    except OSError as error:
        raise InputRefused("weights.damaged", f"{path}: cannot be read ({error.strerror})") from None
    if not data.endswith(digest(data[:-DIGEST_BYTES])):
        raise InputRefused(
            "weights.damaged", f"{path}: damaged, changed or no weight file of timberhand; fetch or train it again"
        )
    try:
        model = _core().read_model(data)
        metadata = model.rt_info["framework"] if model.has_rt_info("framework") else {}
        facts = {key: value.astype(str) for key, value in metadata.items()}
        file_interface = (facts.get("network"), *_ports(model))
    except (RuntimeError, ValueError, LookupError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise InputRefused("weights.damaged", f"{path}: OpenVINO cannot read it ({reason}); train it again") from None
    if file_interface != (interface.name, interface.channels, dict(interface.outputs)):
        raise InputRefused(
            "weights.other-network",
            f"{path}: weights of {facts.get('network', 'an unknown network')!r} do not fit this version of "
            f"{interface.name!r}; train it again",
        )
    if not all(np.isfinite(array).all() for _, array in _constants(model)):
        raise InputRefused("weights.not-finite", f"{path}: some values are not finite; train it again")
    return Weights(interface, model, facts)


class OpenVinoNet:
    """A network compiled for images of one shape.

    It uses one thread, because control shares the computer.  The precision is always set explicitly: by default,
    OpenVINO selects bf16 where the processor has matrix tiles.

    Args:
        weights: the network.
        shape: of the input images, (N, C, H, W).
        precision: "f32", or "bf16" (about three digits; faster where the processor supports it).
        outputs: those that are computed; all by default.

    Raises:
        InputRefused: the shape does not fit the network, or the precision is unknown.
    """

    def __init__(
        self,
        weights: Weights,
        shape: tuple[int, int, int, int],
        precision: str = "f32",
        outputs: tuple[str, ...] = (),
    ) -> None:
        name, channels = weights.interface.name, weights.interface.channels
        if len(shape) != 4 or shape[1] != channels or min(shape) < 1:
            raise InputRefused("network.bad-shape", f"network {name} needs images (N, {channels}, H, W), not {shape}")
        if precision not in PRECISIONS:
            raise InputRefused("network.bad-precision", f"precision {precision!r} is none of {', '.join(PRECISIONS)}")
        self.name, self.shape = name, shape
        self._outputs = outputs or tuple(weights.interface.outputs)
        model = weights.model.clone()
        results = {result.output(0).any_name: result for result in model.get_results()}
        for output in results.keys() - set(self._outputs):
            model.remove_result(results[output])
        model.reshape(list(shape))
        settings = {
            "INFERENCE_NUM_THREADS": 1,
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,
            "INFERENCE_PRECISION_HINT": precision,
        }
        self._request = _core().compile_model(model, "CPU", settings).create_infer_request()

    def __call__(self, images: np.ndarray) -> dict[str, np.ndarray]:
        """Compute every output by name, (N, C, H, W) float32; the caller owns the arrays.

        Raises:
            InputRefused: the images have another shape than the compiled one.
        """
        if images.shape != self.shape:
            raise InputRefused(
                "network.bad-images", f"network {self.name} was compiled for images {self.shape}, not {images.shape}"
            )
        outputs = self._request.infer([np.ascontiguousarray(images, np.float32)])
        return {name: outputs[name] for name in self._outputs}


def _ports(model: Any) -> tuple[int, dict[str, int]]:
    """Return the channels of the input and of every output."""

    def channels(port: Any) -> int:
        width = port.partial_shape[1]
        return int(width.get_length()) if width.is_static else 0

    return channels(model.input(0)), {port.any_name: channels(port) for port in model.outputs}


def _constants(model: Any) -> list[tuple[str, np.ndarray]]:
    return [(op.get_friendly_name(), op.data) for op in model.get_ops() if op.get_type_name() == "Constant"]


def _is_trained(name: str) -> bool:
    """Tell by its name whether an array is trained: LAYER.weight and so on; a constant of the graph has a path with
    slashes or a number.
    """
    return "." in name and "/" not in name


@cache
def _core() -> Any:
    """Return the process's one core.

    The package is imported without its telemetry: its tools use their own stub when that module cannot be imported.

    Each core makes the thread's alternate signal stack its own and restores the one before when it ends
    (openvinotoolkit/openvino pull request 11894).  Of two cores the second would restore the stack of the first, which
    is unmapped by then, and the next signal would kill the process.
    """
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    return openvino.Core()
