"""Networks on disk: safetensors, with what is needed to build the network again in the file's header.

Nothing here is a pickle, so a file from a stranger can be opened.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from lidarsim import GridSpec
from scenegen.errors import DatasetError, ScenegenError, printable
from scenegen.files import read_bounded, write_whole
from scenegen.limits import MOST_HEADER_BYTES, MOST_WEIGHTS_BYTES
from scenegen.model.config import NetworkConfig
from scenegen.model.network import Network

FORMAT = "scenegen-network"
VERSION = 1
DTYPES = (torch.float32, torch.int64)
"""What weights and counts are stored as."""


class CheckpointError(ScenegenError):
    """A file does not hold the network that it should."""


def save_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write `tensors` and a JSON `header`, whole or not at all. Raises DatasetError where the disk refuses."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_whole(path, save(plain, {"header": json.dumps(header)}))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `save_tensors` wrote: tensors and header. Raises CheckpointError for anything else, and for tensors that
    hold NaN or infinity."""
    try:
        content = read_bounded(path, MOST_WEIGHTS_BYTES)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; give a .safetensors file that `scenegen train` wrote") from None
    except DatasetError as error:
        raise CheckpointError(str(error)) from None
    length = int.from_bytes(content[:8], "little")
    try:
        if length > MOST_HEADER_BYTES:
            raise ValueError(f"a header of {length} bytes, expected {MOST_HEADER_BYTES} at most")
        about = json.loads(content[8 : 8 + length])["__metadata__"]["header"] if length else "{}"
        header, tensors = dict(json.loads(about)), load(content)
    except (SafetensorError, ValueError, TypeError, KeyError, RecursionError) as error:
        what = f"{_what_it_is(content)} ({printable(error)[:200]})"
        raise CheckpointError(f"{path}: {what}; expected a .safetensors file") from None
    for name, tensor in tensors.items():
        if tensor.dtype not in DTYPES:
            raise CheckpointError(f"{path}: {printable(name)[:100]} holds {tensor.dtype}, expected float32")
        if not tensor.isfinite().all():
            raise CheckpointError(f"{path}: {printable(name)[:100]} holds NaN or infinity; train it again")
    return tensors, header


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
        config, grid = network_from(header)
        about = dict(header.get("about", {}))
        with torch.device("meta"):  # takes no memory: what the file holds is compared before anything is made of it
            network = Network(config)
        if odd := sorted(tensors.keys() ^ network.state_dict().keys()):  # torch would make up some that are missing
            raise ValueError(f"{', '.join(odd[:3])}: there or missing")
        for name, wanted in network.state_dict().items():
            if tensors[name].dtype != wanted.dtype:
                raise ValueError(f"{name} is {tensors[name].dtype}, expected {wanted.dtype}")
        network.load_state_dict(tensors, assign=True)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = printable(error)[:200]
        raise CheckpointError(f"{path}: header and weights do not fit ({reason}); train it again") from None
    return network.eval(), grid, about


def network_from(header: Mapping[str, Any]) -> tuple[NetworkConfig, GridSpec]:
    """The network and the grid that a header names. Raises KeyError, TypeError or ValueError where it names none, or
    one that is too large."""
    settings = dict(header["network"])  # files of earlier commits name no inputs: they take the default
    if "inputs" in settings:
        settings["inputs"] = tuple(settings["inputs"])
    config = NetworkConfig(**settings)
    grid = GridSpec(**{**header["grid"], "shape": tuple(header["grid"]["shape"])})
    config.check_map(grid.shape)
    return config, grid


def _what_it_is(content: bytes) -> str:
    """What a file that is not safetensors may be."""
    if content[:2] in (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05") or content[:4] == b"PK\x03\x04":
        return "is a pickled checkpoint, which could run anything when opened"
    return "is damaged, or not a network"
