"""Weight files in safetensors format, tied to one network.

The header holds the network's name and fingerprint, a digest of the arrays, and facts of the training (data, seed,
metrics) as text.  A file that is truncated, changed, of another network, or with values that are not finite is refused.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialised

from autonomy.networks.graph import Network, fingerprint, parameter_shapes
from runtime.errors import InputRefused

SHIPPED: Final = Path(__file__).parents[1] / "weights"
"""Folder of the weights that are shipped with the package, NAME.safetensors beside its card NAME.md."""


def save(
    path: Path, network: Network, arrays: Mapping[str, np.ndarray], facts: Mapping[str, str], half: bool = False
) -> None:
    """Write a weight file atomically; ``half`` rounds convolutions to float16, which halves the file.

    Raises:
        InputRefused: the arrays are not the network's.
    """
    shapes = parameter_shapes(network)
    if {name: a.shape for name, a in arrays.items()} != shapes:
        raise InputRefused(
            "network.bad-arrays", f"names or shapes of the arrays are not those of network {network.name}"
        )
    whole = {name: np.ascontiguousarray(arrays[name], np.float32) for name in shapes}
    if half:
        whole = {name: a.astype(np.float16) if a.ndim == 4 else a for name, a in whole.items()}
    own = {"network": network.name, "fingerprint": fingerprint(network), "digest": _digest(whole)}
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    draft.write_bytes(serialised(whole, {**facts, **own}))
    os.replace(draft, path)


def load(path: Path, network: Network) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The network's arrays and the header's facts.

    Raises:
        InputRefused: the file is missing, truncated, changed, or of another network.
    """
    try:
        with safe_open(path, "numpy") as file:
            facts = dict(file.metadata() or {})
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise InputRefused("weights.missing", f"{path}: no such weight file; `timberhand train` makes one") from None
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise InputRefused(
            "weights.damaged", f"{path}: damaged or not a safetensors file ({error}); fetch or train it again"
        ) from None
    if facts.get("fingerprint") != fingerprint(network):
        raise InputRefused(
            "weights.other-network",
            f"{path}: weights of {facts.get('network', 'an unknown network')!r} do not fit this version of "
            f"{network.name!r}; train it again",
        )
    if {name: a.shape for name, a in arrays.items()} != parameter_shapes(network) or facts.get("digest") != _digest(
        arrays
    ):
        raise InputRefused("weights.changed", f"{path}: its arrays were changed; fetch or train it again")
    if not all(np.isfinite(a).all() for a in arrays.values()):
        raise InputRefused("weights.not-finite", f"{path}: some values are not finite; train it again")
    return {name: a.astype(np.float32, copy=False) for name, a in arrays.items()}, facts


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()[:16]
