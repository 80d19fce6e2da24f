"""Networks on disk: safetensors, with what is needed to build the network again in the file's
header.

Nothing here is a pickle, so a file from a stranger can be opened.
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from lidarsim import GridSpec
from lidarsim.parameters import short_repr
from scenegen.base.errors import DatasetError, ScenegenError, printable, reraise_as
from scenegen.base.files import Json, write_atomic
from scenegen.base.limits import MAX_HEADER_BYTES, MAX_WEIGHTS_BYTES
from scenegen.base.reading import read_bounded
from scenegen.model.config import NetworkConfig, is_own
from scenegen.model.network import build

FORMAT = "scenegen-network"
VERSION = 1
STEM_STRIDE = 2
"""The only stem there is; headers of earlier versions name it."""
DTYPES = (torch.float32, torch.int64)
"""What weights and counts are stored as."""
PICKLES = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"PK\x03\x04")
"""How pickled files begin, plain or zipped."""


class CheckpointError(ScenegenError):
    """A file does not hold the network that it should."""


def save_tensors(path: Path, tensors: Mapping[str, Tensor], header: Json) -> None:
    """Write `tensors` and a JSON `header`, whole or not at all. Raises DatasetError where the disk
    refuses."""
    whole = torch.contiguous_format
    plain = {  # copies, for two names may share one tensor
        name: tensor.detach().cpu().clone(memory_format=whole) for name, tensor in tensors.items()
    }
    write_atomic(path, save(plain, {"header": json.dumps(header)}))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], Json]:
    """What `save_tensors` wrote: tensors and header. Raises CheckpointError for anything else, and
    for tensors that hold NaN or infinity."""
    with reraise_as(CheckpointError, of=DatasetError):
        content = read_bounded(path, MAX_WEIGHTS_BYTES)
    length = int.from_bytes(content[:8], "little")
    try:
        if length > MAX_HEADER_BYTES:
            raise ValueError(f"a header of {length} bytes, expected {MAX_HEADER_BYTES} at most")
        text = json.loads(content[8 : 8 + length])["__metadata__"]["header"] if length else "{}"
        header, tensors = dict(json.loads(text)), load(content)
    except (SafetensorError, ValueError, TypeError, KeyError, RecursionError) as error:
        fault = "is damaged, or not a network"
        if content.startswith(PICKLES):
            fault = "is a pickled checkpoint, which could run anything when opened"
        raise CheckpointError(
            f"{path}: {fault} ({printable(error)[:200]}); expected a .safetensors file"
        ) from None
    for name, tensor in tensors.items():
        if tensor.dtype not in DTYPES or tensor.ndim > 16:  # torch does not look into more than 64
            raise CheckpointError(
                f"{path}: {printable(name)[:100]} holds {tensor.dtype} along {tensor.ndim} axes, "
                "expected float32 along a few"
            )
        if not tensor.isfinite().all():
            raise CheckpointError(
                f"{path}: {printable(name)[:100]} holds NaN or infinity; train it again"
            )
    return tensors, header


def save_network(path: Path, network: Any, grid: GridSpec, about: Json) -> None:
    """Write a network for maps on `grid`, with whatever else `about` says of it."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "network": asdict(network.config),
        "grid": asdict(grid),
        "about": dict(about),
    }
    save_tensors(path, network.state_dict(), header)


def load_network(path: Path, own: Collection[str] = ()) -> tuple[Any, GridSpec, Json]:
    """A network ready to complete maps, their grid, and what is said of it.

    Of the code of users' own that the header names, only what is in `own`, module:Object each, is
    imported. Raises CheckpointError for a file that is damaged, a pickle, of another network, or
    of own code that is not in `own`.
    """
    tensors, header = load_tensors(path)
    if (version := [header.get(name) for name in ("format", "version")]) != [FORMAT, VERSION]:
        raise CheckpointError(
            f"{path}: format and version are {printable(version)[:100]}, this scenegen reads "
            f"{FORMAT} {VERSION}; not a network, or of another scenegen"
        )
    try:
        config, grid = network_from(header)
        about = dict(header.get("about", {}))
        check_own(path, own, config.variant, *config.inputs, *config.targets)
        # on "meta", a network takes no memory: the file is compared before anything is made of it
        with torch.device("cpu" if is_own(config.variant) else "meta"):
            network = build(config)
        expected = network.state_dict()
        if odd := sorted(tensors.keys() ^ expected.keys()):  # torch would make up some missing ones
            raise ValueError(f"{', '.join(odd[:3])}: there or missing")
        for name, values in expected.items():
            if tensors[name].dtype != values.dtype:
                raise ValueError(f"{name} is {tensors[name].dtype}, expected {values.dtype}")
        network.load_state_dict(tensors, assign=True)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = printable(error)[:200]
        raise CheckpointError(
            f"{path}: header and weights do not fit ({reason}); train it again"
        ) from None
    return network.eval(), grid, about


def check_own(path: str | Path, own: Collection[str], *names: str) -> None:
    """Raise CheckpointError where code among `names` is a user's own, and not in `own`.

    A stranger's file may name any module, and importing one runs it.
    """
    needed = {name for name in names if is_own(name)}
    if not needed <= set(own):
        spelled = printable(",".join(sorted(needed.union(own))))[:200]
        raise CheckpointError(
            f"{path}: is made of {spelled}, which is imported only if you name it; if you trust "
            f"that code, give the network as {spelled}@{path}"
        )


def current_settings(network: Json) -> Json:
    """The settings of a network as this version writes them: without the stem stride that versions
    up to 0.2.0 wrote, and with targets, which they did not have.

    Raises:
        ValueError: if the network has a stem that this version does not build.
    """
    network = {"targets": [], "channels": [], **network}
    if (stride := network.pop("stem_stride", STEM_STRIDE)) != STEM_STRIDE:
        raise ValueError(f"stem_stride = {short_repr(stride)}: networks have {STEM_STRIDE}")
    return network


def network_from(header: Json) -> tuple[NetworkConfig, GridSpec]:
    """The network and the grid that a header names; nothing is imported for it. Raises KeyError,
    TypeError or ValueError where it names none, or one that is too large."""
    config = NetworkConfig(**current_settings(header["network"]))
    grid = GridSpec(**{**header["grid"], "shape": tuple(header["grid"]["shape"])})
    config.check_map(grid.shape)
    return config, grid
