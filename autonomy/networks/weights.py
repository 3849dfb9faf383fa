"""Weight files: safetensors, tied to the network they belong to and to every bit they held when written.

The header holds the network's name and fingerprint, a digest of the numbers, and what the trainer has to say (data,
seed, metrics) as text.  A file that is cut off, changed, of another network or with numbers that are none is refused
with a sentence.
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

SHIPPED: Final = Path(__file__).parents[1] / "weights"
"""Where the weights lie that come with the package, NAME.safetensors beside its card NAME.md."""


class WeightsRefused(ValueError):
    """A weight file that cannot be used; the message says why and what to do."""


def save(path: Path, network: Network, arrays: Mapping[str, np.ndarray], facts: Mapping[str, str]) -> None:
    """Write the file at once or not at all.

    Raises:
        ValueError: arrays that are not the network's.
    """
    shapes = parameter_shapes(network)
    if {name: a.shape for name, a in arrays.items()} != shapes:
        raise ValueError(f"these arrays are not those of network {network.name}")
    whole = {name: np.ascontiguousarray(arrays[name], np.float32) for name in shapes}
    own = {"network": network.name, "fingerprint": fingerprint(network), "digest": _digest(whole)}
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    draft.write_bytes(serialised(whole, {**facts, **own}))
    os.replace(draft, path)


def load(path: Path, network: Network) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The network's arrays and the header's facts.

    Raises:
        WeightsRefused: no such file, a file that is cut off or changed, or one of another network.
    """
    try:
        with safe_open(path, "numpy") as file:
            facts = dict(file.metadata() or {})
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise WeightsRefused(f"{path}: there is no such weight file; `timberhand train` makes one") from None
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise WeightsRefused(f"{path}: is damaged or no safetensors file ({error}); fetch or train it again") from None
    if facts.get("fingerprint") != fingerprint(network):
        raise WeightsRefused(
            f"{path}: holds weights of {facts.get('network', 'an unknown network')!r} that do not fit this version of "
            f"{network.name!r}; train it again"
        )
    if {name: a.shape for name, a in arrays.items()} != parameter_shapes(network) or facts.get("digest") != _digest(
        arrays
    ):
        raise WeightsRefused(f"{path}: its numbers are not those that were written; fetch or train it again")
    if not all(np.isfinite(a).all() for a in arrays.values()):
        raise WeightsRefused(f"{path}: holds numbers that are not finite; train it again")
    return arrays, facts


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()[:16]
