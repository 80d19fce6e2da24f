"""Networks on disk: safetensors, with what is needed to build the network again in the file's header.

Nothing here is a pickle, so a file from a stranger can be opened.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from lidarsim import GridSpec
from model.network import Network, NetworkConfig
from scenegen.errors import ScenegenError
from scenegen.files import write_whole

FORMAT = "scenegen-network"
VERSION = 1


class CheckpointError(ScenegenError):
    """A file does not hold the network that it should."""


def save_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write `tensors` and a JSON `header`, whole or not at all. Raises DatasetError where the disk refuses."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_whole(path, save(plain, {"header": json.dumps(header)}))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `save_tensors` wrote: tensors and header. Raises CheckpointError for anything else."""
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("header", "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, dict(header)  # noqa: SIM118 (no iterator)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; give a .safetensors file that `scenegen train` wrote") from None
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise CheckpointError(f"{path}: {_what_it_is(path)} ({error}); expected a .safetensors file") from None


def save_network(path: Path, network: Network, grid: GridSpec, about: Mapping[str, Any]) -> None:
    """Write a network for maps on `grid`, with whatever else `about` says of it."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "network": dataclasses.asdict(network.config),
        "grid": dataclasses.asdict(grid),
        "about": dict(about),
    }
    save_tensors(path, network.state_dict(), header)


def load_network(path: Path) -> tuple[Network, GridSpec, dict[str, Any]]:
    """A network ready to complete maps, their grid, and what is said of it.

    Raises CheckpointError for a file that is missing, damaged, a pickle, or of another network.
    """
    tensors, header = load_tensors(path)
    if header.get("format") != FORMAT:
        raise CheckpointError(f'{path}: not a network of scenegen, expected "format": "{FORMAT}" in its header')
    if header.get("version") != VERSION:
        raise CheckpointError(
            f"{path}: network format {header.get('version')}, this scenegen reads {VERSION}; install one that matches"
        )
    try:
        network = Network(NetworkConfig(**header["network"]))
        grid, about = grid_from(header), dict(header.get("about", {}))
        if any(edge % network.config.stride for edge in grid.shape):
            raise ValueError(f"grid {grid.shape}: edges must be multiples of {network.config.stride}")
        network.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise CheckpointError(f"{path}: header and weights do not fit ({reason}); train it again") from None
    return network.eval(), grid, about


def grid_from(header: Mapping[str, Any]) -> GridSpec:
    """The grid that a header names. Raises KeyError, TypeError or ValueError where it names none."""
    return GridSpec(**{**header["grid"], "shape": tuple(header["grid"]["shape"])})


def _what_it_is(path: Path) -> str:
    """What a file that is not safetensors may be."""
    try:
        start = path.open("rb").read(4)
    except OSError:
        return "cannot be read"
    if start[:2] in (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05") or start == b"PK\x03\x04":
        return "is a pickled checkpoint, which could run anything when opened"
    return "is damaged, or not a network"
