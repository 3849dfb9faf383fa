"""Weight files: OpenVINO computes what torch does, nothing is lost on the way, and an invalid file is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn

from autonomy.grasp.network import PAPER
from autonomy.networks import DIGEST_BYTES, SHIPPED, Interface, OpenVinoNet, digest, load
from autonomy.perception.papers import BOXES
from autonomy.perception.segmentation.mask_network import MASKS
from autonomy.perception.segmentation.network import interface_of
from autonomy.perception.segmentation.segment_merging import MERGE_NETWORK, QUALITY_NETWORK
from runtime.errors import InputRefused
from tests.codes import coded
from training.common.loop import seeded
from training.common.weight_file import restore, save
from training.detection.networks import BoxNetwork, MaskNetwork, UNet, scoring_network
from training.grasp.network_training import GraspNetwork

TINY = Interface("tiny", 1, {"a": 2, "y": 3})
SHIPPED_NETWORKS = {
    "grasp_cornell": (PAPER, GraspNetwork, 300),
    "grasp_physical": (PAPER, GraspNetwork, 300),
    "log_boxes": (BOXES, BoxNetwork, 128),
    "logs": (MASKS, MaskNetwork, 128),
    "logs_depth": (interface_of("depth"), lambda: UNet("depth"), 112),
    "logs_rgbd": (interface_of("rgbd"), lambda: UNet("rgbd"), 112),
    "segment_merging": (MERGE_NETWORK, lambda: scoring_network(MERGE_NETWORK.channels), 5),
    "segment_quality": (QUALITY_NETWORK, lambda: scoring_network(QUALITY_NETWORK.channels), 5),
}


class Tiny(nn.Module):
    """Two outputs, the second of the first."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Conv2d(1, 2, 3, padding=1), nn.BatchNorm2d(2))
        self.last = nn.Conv2d(2, 3, 1)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        a = self.first(images)
        return a, self.last(a)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "tiny.onnx"
    save(file, seeded(Tiny, 1), TINY, {"seed": "3"})
    return file


@pytest.mark.parametrize("name", SHIPPED_NETWORKS)
def test_shipped_weights_are_valid_and_openvino_and_torch_agree_on_them(name: str) -> None:
    onnx.checker.check_model(onnx.load(SHIPPED / f"{name}.onnx"), full_check=True)
    interface, make, side = SHIPPED_NETWORKS[name]
    weights, net = load(SHIPPED / f"{name}.onnx", interface), make().eval()
    restore(net, weights.arrays())
    images = np.random.default_rng(1).normal(size=(1, interface.channels, side, 2 * side)).astype(np.float32)
    with torch.inference_mode():
        wanted = net(torch.from_numpy(images))
    wanted = wanted if isinstance(wanted, tuple) else (wanted,)
    found = OpenVinoNet(weights, images.shape)(images)
    assert list(found) == list(interface.outputs)
    for got, expected in zip(found.values(), wanted, strict=True):
        assert np.abs(got - expected.numpy()).max() <= 1e-5 * np.abs(expected.numpy()).max()


def test_every_shipped_file_is_compared() -> None:
    assert {file.stem for file in SHIPPED.glob("*.onnx")} == SHIPPED_NETWORKS.keys()


@pytest.mark.parametrize("half", [False, True])
def test_weights_are_loaded_as_they_were_saved(tmp_path: Path, half: bool) -> None:
    net, file = seeded(Tiny, 1), tmp_path / "tiny.onnx"
    save(file, net, TINY, {"seed": "3"}, half)
    weights = load(file, TINY)
    assert weights.facts == {"seed": "3", "network": "tiny", "digest": file.read_bytes()[-DIGEST_BYTES:].decode()}
    assert {type(value) for value in weights.facts.values()} == {str}
    stored = {k: v.numpy() for k, v in net.state_dict().items() if not k.endswith("tracked")}
    found = weights.arrays()
    assert found.keys() == stored.keys()
    for name, values in stored.items():
        rounded = values.astype(np.float16) if half and values.ndim == 4 else values
        assert (found[name] == rounded).all()
    assert list(tmp_path.iterdir()) == [file]
    again = seeded(Tiny, 2)
    restore(again, found)
    assert (again.last.weight.detach().numpy() == found["last.weight"]).all()


def test_outputs_keep_their_names_and_can_be_chosen(path: Path) -> None:
    weights, ones = load(path, TINY), np.ones((1, 1, 4, 4), np.float32)
    both = OpenVinoNet(weights, ones.shape)(ones)
    assert {name: v.shape[1] for name, v in both.items()} == TINY.outputs
    alone = OpenVinoNet(weights, ones.shape, outputs=("y",))(ones)
    assert list(alone) == ["y"] and (alone["y"] == both["y"]).all()
    assert OpenVinoNet(weights, (1, 1, 6, 5)).shape == (1, 1, 6, 5), "the read network is compiled for any size"


def test_outputs_are_not_overwritten_by_the_next_inference(path: Path) -> None:
    net = OpenVinoNet(load(path, TINY), (1, 1, 6, 6))
    first = net(np.ones((1, 1, 6, 6), np.float32))["y"]
    kept = first.copy()
    net(np.zeros((1, 1, 6, 6), np.float32))
    assert (first == kept).all()


def test_bf16_is_close_to_f32(path: Path) -> None:
    weights = load(path, TINY)
    images = np.random.default_rng(2).normal(size=(1, 1, 16, 16)).astype(np.float32)
    exact, rough = (OpenVinoNet(weights, images.shape, p)(images)["y"] for p in ("f32", "bf16"))
    assert np.abs(rough - exact).max() <= 0.05 * np.abs(exact).max()


def test_another_shape_or_precision_is_refused(path: Path) -> None:
    weights = load(path, TINY)
    with pytest.raises(InputRefused, check=coded("network.bad-images")):
        OpenVinoNet(weights, (1, 1, 6, 6))(np.zeros((1, 1, 6, 7), np.float32))
    with pytest.raises(InputRefused, check=coded("network.bad-shape")):
        OpenVinoNet(weights, (1, 3, 6, 6))
    with pytest.raises(InputRefused, check=coded("network.bad-precision")):
        OpenVinoNet(weights, (1, 1, 6, 6), "int4")


@pytest.mark.parametrize("damage", ["cut", "header", "flipped", "empty", "text", "folder", "missing"])
def test_a_damaged_weight_file_is_refused(path: Path, damage: str) -> None:
    whole = path.read_bytes()
    path.unlink()
    if damage == "folder":
        path.mkdir()
    elif damage != "missing":
        at = whole.index(seeded(Tiny, 1).last.weight.detach().numpy().tobytes())
        flipped = whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
        path.write_bytes(
            {"cut": whole[:-9], "header": whole[:20], "flipped": flipped, "empty": b"", "text": b"x" * 99}[damage]
        )
    with pytest.raises(InputRefused, match=r"tiny\.onnx") as refused:
        load(path, TINY)
    assert refused.value.code == ("weights.missing" if damage == "missing" else "weights.damaged")


def sealed(path: Path, body: bytes) -> Path:
    """A file with the right hash at its end, whatever it is."""
    path.write_bytes(body + digest(body))
    return path


def test_a_sealed_file_that_openvino_cannot_read_is_refused(path: Path) -> None:
    with pytest.raises(InputRefused, check=coded("weights.damaged")):
        load(sealed(path, b"no network"), TINY)


@pytest.mark.parametrize(
    "other", [Interface("other", 1, TINY.outputs), Interface("tiny", 2, TINY.outputs), Interface("tiny", 1, {"y": 3})]
)
def test_weights_of_another_network_are_refused(path: Path, other: Interface) -> None:
    with pytest.raises(InputRefused, check=coded("weights.other-network")):
        load(path, other)


def test_values_that_are_not_finite_are_refused(path: Path) -> None:
    net = seeded(Tiny, 1)
    with torch.no_grad():
        net.last.bias[0] = torch.nan
    with pytest.raises(InputRefused, check=coded("weights.not-finite")):
        save(path, net, TINY, {})
    model = onnx.load(path)
    (bias,) = (stored for stored in model.graph.initializer if stored.name == "last.bias")
    bias.CopyFrom(onnx.numpy_helper.from_array(np.full(3, np.nan, np.float32), bias.name))
    with pytest.raises(InputRefused, check=coded("weights.not-finite")):
        load(sealed(path, model.SerializeToString()[:-DIGEST_BYTES]), TINY)


def test_a_file_without_facts_is_refused(path: Path) -> None:
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {"digest": "0" * DIGEST_BYTES})
    with pytest.raises(InputRefused, check=coded("weights.other-network")):
        load(sealed(path, model.SerializeToString()[:-DIGEST_BYTES]), TINY)
