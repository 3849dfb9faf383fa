"""The weight file of a trained network, ONNX, and the model card beside it: data, schedule, metrics, limits and the
command that reproduces it.
"""

from __future__ import annotations

import copy
import hashlib
import io
import os
import platform
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

import numpy as np
import onnx
import torch

from autonomy.networks import DIGEST_BYTES, Interface, digest
from runtime.errors import InputRefused

SIDE_PX: Final = 192
"""Of the picture that a network is traced with: a multiple of the strides of all networks."""


@dataclass(frozen=True, slots=True)
class Card:
    """Contents of a model card: title, purpose, training data, schedule, seed, metrics (name to text), limits, and the
    command that reproduces the weights.
    """

    title: str
    does: str
    data: str
    schedule: str
    seed: int
    metrics: Mapping[str, str]
    limits: str
    command: str


def write(
    path: Path,
    net: torch.nn.Module,
    interface: Interface,
    card: Card,
    facts: Mapping[str, str],
    half: bool = False,
) -> Path:
    """Write the weights to ``path`` and the card beside them; return the card's path.

    ``facts`` are written to the weight file's metadata with data, command, seed and metrics; ``half`` as in ``save``.
    """
    header = {"data": card.data, "seed": str(card.seed), "command": card.command}
    save(path, net, interface, {**header, **card.metrics, **facts}, half)
    beside = path.with_suffix(".md")
    beside.write_text(text(path, net, interface, card))
    return beside


def save(path: Path, net: torch.nn.Module, interface: Interface, facts: Mapping[str, str], half: bool = False) -> None:
    """Write a weight file atomically; ``half`` rounds convolutions to float16, which halves the file.

    Batch normalisations stay as they are, so that a training can go on from the file.  Torch's newer exporter
    (``dynamo=True``) merges them into the convolutions, and takes half a minute instead of a tenth of a second.

    Raises:
        InputRefused: some weights are not finite.
    """
    if not all(values.isfinite().all() for values in net.state_dict().values()):
        raise InputRefused("weights.not-finite", f"{path}: some values of the trained network are not finite")
    finished = copy.deepcopy(net).cpu().eval()
    finished.training = True  # its layers are not: otherwise the exporter stores arrays of equal values only once
    traced, outputs = io.BytesIO(), list(interface.outputs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is a newer exporter
        torch.onnx.export(
            finished,
            (torch.zeros(1, interface.channels, SIDE_PX, SIDE_PX),),
            traced,  # type: ignore[arg-type]  # the stubs know paths only
            input_names=["input"],
            output_names=outputs,
            dynamic_axes={name: {0: "n", 2: "h", 3: "w"} for name in ("input", *outputs)},
            training=torch.onnx.TrainingMode.PRESERVE,
            do_constant_folding=False,
            opset_version=17,
            dynamo=False,
        )
    model = onnx.load_from_string(traced.getvalue())
    if half:
        _halve(model.graph)
    placeholder = "0" * DIGEST_BYTES
    onnx.helper.set_model_props(model, {**facts, "network": interface.name, "digest": placeholder})
    whole = model.SerializeToString()
    assert whole.endswith(placeholder.encode()), "metadata is the last field of a model without functions"
    body = whole[:-DIGEST_BYTES]
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    draft.write_bytes(body + digest(body))
    os.replace(draft, path)


def _halve(graph: onnx.GraphProto) -> None:
    """Store the convolutions' weights as float16, each with a cast to float32 behind it."""
    for stored in graph.initializer:
        if len(stored.dims) == 4:
            for node in graph.node:
                for i, name in enumerate(node.input):
                    if name == stored.name:
                        node.input[i] = f"{name}_f32"
            exact = onnx.numpy_helper.to_array(stored)
            stored.CopyFrom(onnx.numpy_helper.from_array(exact.astype(np.float16), stored.name))
            cast = onnx.helper.make_node("Cast", [stored.name], [f"{stored.name}_f32"], to=onnx.TensorProto.FLOAT)
            graph.node.insert(0, cast)


def restore(net: torch.nn.Module, arrays: Mapping[str, np.ndarray]) -> None:
    """Load the arrays of a weight file (``Weights.arrays``) into the network that it was made of."""
    missing, unexpected = net.load_state_dict({k: torch.from_numpy(a) for k, a in arrays.items()}, strict=False)
    assert not unexpected and all(name.endswith("num_batches_tracked") for name in missing), (missing, unexpected)


def parameter_count(net: torch.nn.Module) -> int:
    """Count the trained parameters (without the statistics of batch normalisation)."""
    return sum(values.numel() for values in net.parameters())


def text(path: Path, net: torch.nn.Module, interface: Interface, card: Card) -> str:
    """Format the card as Markdown."""
    rows = {
        "file": f"`{path.name}`, {path.stat().st_size / 1e6:.2f} MB, "
        f"sha256 `{hashlib.sha256(path.read_bytes()).hexdigest()}`",
        "network": f"`{interface.name}`, {parameter_count(net):,} parameters",
        "data": card.data,
        "schedule": card.schedule,
        "seed": str(card.seed),
        "trained on": f"{platform.machine()}, Python {platform.python_version()}, torch {version('torch')}",
        **card.metrics,
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    return (
        f"# {card.title}\n\n{card.does}\n\n| | |\n|---|---|\n{table}\n\n"
        f"Not good for: {card.limits}\n\nMade by\n\n```\n{card.command}\n```\n"
    )
