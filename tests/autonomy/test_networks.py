"""Network descriptions: torch and OpenVINO agree on every layer, and an invalid weight file is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from autonomy.networks.graph import (
    INPUT,
    Add,
    AveragePool,
    BatchNorm,
    Concat,
    Conv,
    MaxPool,
    Network,
    Relu,
    Resize,
    Sigmoid,
    parameter_count,
    parameter_shapes,
)
from autonomy.networks.openvino_net import OpenVinoNet
from autonomy.networks.torch_net import random_net
from autonomy.networks.weights import load, save
from runtime.errors import InputRefused
from tests.codes import coded

LAYERS = {
    "conv": (Conv("y", 5, 3),),
    "wide": (Conv("y", 4, 11, bias=False),),
    "strided": (Conv("y", 4, 3, stride=2),),
    "dilated": (Conv("y", 4, 3, dilation=2),),
    "depthwise": (Conv("y", 6, 5, groups=3),),
    "norm": (BatchNorm("y"),),
    "relu": (Relu("y"),),
    "sigmoid": (Sigmoid("y"),),
    "max": (MaxPool("y", 2),),
    "mean": (AveragePool("y", 3),),
    "twice": (Resize("y", 2),),
    "thrice": (Resize("y", 3),),
    "concat": (Conv("a", 2, 1), Concat("y", (INPUT, "a"))),
    "add": (Conv("a", 3, 1), Add("y", (INPUT, "a", INPUT))),
}
TINY = Network("tiny", 1, (Conv("a", 2, 3), BatchNorm("n"), Conv("y", 1, 1)), ("y",))


def drawn(network: Network, seed: int = 0) -> dict[str, np.ndarray]:
    """Random weights with varied statistics."""
    rng = np.random.default_rng(seed)
    return {
        name: rng.uniform(0.5, 2.0, s).astype(np.float32)
        if name.endswith("running_var")
        else rng.normal(0.0, 1.0 / math.sqrt(max(1, math.prod(s[1:]))), s).astype(np.float32)
        for name, s in parameter_shapes(network).items()
    }


@pytest.mark.parametrize("name", LAYERS)
def test_both_back_ends_agree_on_every_layer(name: str) -> None:
    network = Network(name, 3, LAYERS[name], ("y",))
    arrays = drawn(network)
    net = random_net(network, 0).eval()
    net.load(arrays)
    images = np.random.default_rng(1).normal(size=(2, 3, 13, 16)).astype(np.float32)
    with torch.inference_mode():
        wanted = net(torch.from_numpy(images))["y"].numpy()
    got = OpenVinoNet(network, arrays, images.shape)(images)["y"]
    assert got.shape == wanted.shape
    if isinstance(LAYERS[name][-1], Conv):  # "same" padding
        stride = LAYERS[name][-1].stride
        assert got.shape[2:] == (math.ceil(13 / stride), math.ceil(16 / stride))
    assert np.abs(got - wanted).max() <= 1e-4
    assert np.abs(wanted).max() > 0.1  # nothing was compared to nothing


def test_upsampling_is_bilinear() -> None:
    network = Network("up", 1, (Resize("y", 2),), ("y",))
    row = np.array([[[[0.0, 4.0]]]], np.float32)
    assert OpenVinoNet(network, {}, (1, 1, 1, 2))(row)["y"][0, 0, 0].tolist() == [0.0, 1.0, 3.0, 4.0]


def test_several_outputs_keep_their_names() -> None:
    network = Network("two", 1, (Conv("a", 2, 1), Conv("b", 3, 1, source=INPUT)), ("b", "a"))
    found = OpenVinoNet(network, drawn(network), (1, 1, 4, 4))(np.ones((1, 1, 4, 4), np.float32))
    assert {name: v.shape[1] for name, v in found.items()} == {"a": 2, "b": 3}


def test_outputs_are_not_overwritten_by_the_next_inference() -> None:
    net = OpenVinoNet(TINY, drawn(TINY), (1, 1, 6, 6))
    first = net(np.ones((1, 1, 6, 6), np.float32))["y"]
    kept = first.copy()
    net(np.zeros((1, 1, 6, 6), np.float32))
    assert (first == kept).all()


def test_bf16_is_close_to_f32() -> None:
    net = OpenVinoNet(TINY, drawn(TINY), (1, 1, 16, 16), "bf16")
    images = np.random.default_rng(2).normal(size=(1, 1, 16, 16)).astype(np.float32)
    exact = OpenVinoNet(TINY, drawn(TINY), (1, 1, 16, 16))(images)["y"]
    assert np.abs(net(images)["y"] - exact).max() <= 0.05 * np.abs(exact).max()


def test_another_shape_or_precision_is_refused() -> None:
    with pytest.raises(InputRefused, check=coded("network.bad-images")):
        OpenVinoNet(TINY, drawn(TINY), (1, 1, 6, 6))(np.zeros((1, 1, 6, 7), np.float32))
    with pytest.raises(InputRefused, check=coded("network.bad-shape")):
        OpenVinoNet(TINY, drawn(TINY), (1, 3, 6, 6))
    with pytest.raises(InputRefused, check=coded("network.bad-precision")):
        OpenVinoNet(TINY, drawn(TINY), (1, 1, 6, 6), "int4")


@pytest.mark.parametrize(
    ("layers", "outputs", "code"),
    [
        ((Conv("a", 2, 3), Relu("a")), ("a",), "bad-name"),
        ((Relu("a", source="b"), Relu("b")), ("a",), "unknown-source"),
        ((Conv("a", 2, 4),), ("a",), "even-kernel"),
        ((Conv("a", 3, 3, groups=2),), ("a",), "bad-groups"),
        ((Conv("a", 3, 3), Add("b", (INPUT, "a"))), ("b",), "bad-sum"),
        ((Conv("a", 3, 3),), ("b",), "unknown-output"),
    ],
)
def test_an_invalid_description_is_refused(layers: tuple, outputs: tuple[str, ...], code: str) -> None:
    with pytest.raises(InputRefused, check=coded(f"network.{code}")):
        Network("wrong", 1, layers, outputs)


def test_parameters_are_counted_without_statistics() -> None:
    assert parameter_count(TINY) == (2 * 9 + 2) + 2 * 2 + (2 + 1)
    assert parameter_count(TINY) == sum(p.numel() for p in random_net(TINY, 0).parameters())


def test_a_seed_gives_the_same_net_and_leaves_the_global_generator_alone() -> None:
    before = torch.random.get_rng_state()
    first, second, other = (random_net(TINY, seed).arrays() for seed in (1, 1, 2))
    assert all((first[k] == second[k]).all() for k in first)
    assert any((first[k] != other[k]).any() for k in first)
    assert (torch.random.get_rng_state() == before).all()


def test_weights_are_loaded_as_they_were_saved(tmp_path) -> None:
    path, arrays = tmp_path / "tiny.safetensors", drawn(TINY)
    save(path, TINY, arrays, {"seed": "3"})
    found, facts = load(path, TINY)
    assert facts["seed"] == "3" and facts["network"] == "tiny"
    assert found.keys() == arrays.keys() and all((found[k] == arrays[k]).all() for k in arrays)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("damage", ["cut", "header", "flipped", "empty", "text", "missing"])
def test_a_damaged_weight_file_is_refused(tmp_path, damage: str) -> None:
    path = tmp_path / "tiny.safetensors"
    save(path, TINY, drawn(TINY), {})
    whole = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        flipped = whole[:-3] + bytes([whole[-3] ^ 1]) + whole[-2:]
        path.write_bytes(
            {"cut": whole[:-9], "header": whole[:20], "flipped": flipped, "empty": b"", "text": b"x" * 99}[damage]
        )
    with pytest.raises(InputRefused) as refused:
        load(path, TINY)
    assert refused.value.code == {"missing": "weights.missing", "flipped": "weights.changed"}.get(
        damage, "weights.damaged"
    )
    assert "tiny.safetensors" in str(refused.value)


def test_weights_of_another_network_are_refused(tmp_path) -> None:
    other = Network("other", 1, (Conv("a", 2, 3), Relu("r"), Conv("y", 1, 1)), ("y",))
    path = tmp_path / "w.safetensors"
    save(path, other, drawn(other), {})
    with pytest.raises(InputRefused, check=coded("weights.other-network")):
        load(path, TINY)
    with pytest.raises(InputRefused, check=coded("network.bad-arrays")):
        save(path, TINY, drawn(other), {})


def test_values_that_are_not_finite_are_refused(tmp_path) -> None:
    path, arrays = tmp_path / "w.safetensors", drawn(TINY)
    arrays["a.bias"][0] = np.nan
    save(path, TINY, arrays, {})
    with pytest.raises(InputRefused, check=coded("weights.not-finite")):
        load(path, TINY)


def test_a_file_without_facts_is_refused(tmp_path) -> None:
    path = tmp_path / "w.safetensors"
    save(path, TINY, drawn(TINY), {})
    save_file(load_file(path), path)
    with pytest.raises(InputRefused, check=coded("weights.other-network")):
        load(path, TINY)
