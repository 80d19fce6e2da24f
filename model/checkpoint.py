"""Networks on disk: safetensors files, whose header describes the network so that it can be
rebuilt.

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
from scenegen.model.network import build_network

FORMAT = "scenegen-network"
VERSION = 1
STEM_STRIDE = 2
"""Stride of the stem of every network. Headers of versions up to 0.2.0 name it."""
DTYPES = (torch.float32, torch.int64)
"""Types of stored tensors: weights, and the step counts of batch norms."""
PICKLES = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"PK\x03\x04")
"""First bytes of pickled files, plain or zipped."""


class CheckpointError(ScenegenError):
    """A file does not hold the network that it should."""


def save_tensors(path: Path, tensors: Mapping[str, Tensor], header: Json) -> None:
    """Write tensors and a header as one safetensors file, atomically.

    Args:
        path: The file, which is replaced.
        tensors: Tensors by name, on any device and in any memory layout.
        header: Entries of the header that JSON can hold.

    Raises:
        DatasetError: if the disk refuses.
    """
    layout = torch.contiguous_format  # safetensors stores no other
    plain = {  # copies: two names may share one tensor, which safetensors refuses
        name: tensor.detach().cpu().clone(memory_format=layout) for name, tensor in tensors.items()
    }
    write_atomic(path, save(plain, {"header": json.dumps(header)}))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], Json]:
    """Read a file that `save_tensors` wrote.

    Args:
        path: The file.

    Returns:
        Tensors by name, on the CPU; and the header.

    Raises:
        CheckpointError: if the file is missing, too large, damaged or a pickle, or if a tensor has
            another type than `DTYPES`, or holds NaN or infinity.
    """
    with reraise_as(CheckpointError, of=DatasetError):
        content = read_bounded(path, MAX_WEIGHTS_BYTES)
    # safetensors: eight bytes with the length of the JSON header, the header, then the tensors
    length = int.from_bytes(content[:8], "little")
    try:
        # safetensors itself accepts 100 MB of JSON, which takes far more memory once parsed
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
        # torch's functions fail on more than 64 axes; convolutions have 5
        if tensor.dtype not in DTYPES or tensor.ndim > 16:
            raise CheckpointError(
                f"{path}: {printable(name)[:100]} holds {tensor.dtype} along {tensor.ndim} axes, "
                "expected float32 along a few"
            )
        if not tensor.isfinite().all():
            raise CheckpointError(
                f"{path}: {printable(name)[:100]} holds NaN or infinity; train it again"
            )
    return tensors, header


def save_network(path: Path, network: Any, grid: GridSpec, metadata: Json) -> None:
    """Write a network as one safetensors file.

    Args:
        path: The file, which is replaced.
        network: The network; its `config` and its weights are stored.
        grid: Grid of the maps that it completes.
        metadata: Further entries of the header: settings of the training, figures, versions,
            calibration.

    Raises:
        DatasetError: if the disk refuses.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "network": asdict(network.config),
        "grid": asdict(grid),
        "about": dict(metadata),
    }
    save_tensors(path, network.state_dict(), header)


def load_network(path: Path, trusted: Collection[str] = ()) -> tuple[Any, GridSpec, Json]:
    """Read a network that `save_network` wrote.

    Args:
        path: The file.
        trusted: Own code that may be imported, each as ``module:Object``.

    Returns:
        The network on the CPU, in evaluation mode; the grid of its maps; and the metadata.

    Raises:
        CheckpointError: if the file is damaged, a pickle, or of another version, if its weights do
            not fit its header, or if the header names own code that is not in `trusted`.
        ScenegenError: if trusted code cannot be imported.
    """
    tensors, header = load_tensors(path)
    if (version := [header.get(name) for name in ("format", "version")]) != [FORMAT, VERSION]:
        raise CheckpointError(
            f"{path}: format and version are {printable(version)[:100]}, this scenegen reads "
            f"{FORMAT} {VERSION}; not a network, or of another scenegen"
        )
    try:
        config, grid = network_from(header)
        metadata = dict(header.get("about", {}))
        # before `build_network`, which imports the code
        check_own(path, trusted, config.variant, *config.inputs, *config.targets)
        # on "meta", a network takes no memory, so a header cannot allocate more than the file
        # holds; a user's own class may compute with its weights when it is made
        with torch.device("cpu" if is_own(config.variant) else "meta"):
            network = build_network(config)
        expected = network.state_dict()
        # torch forgives some missing entries, such as step counts of batch norms
        if odd := sorted(tensors.keys() ^ expected.keys()):
            raise ValueError(f"{', '.join(odd[:3])}: there or missing")
        for name, values in expected.items():
            if tensors[name].dtype != values.dtype:
                raise ValueError(f"{name} is {tensors[name].dtype}, expected {values.dtype}")
        network.load_state_dict(tensors, assign=True)  # tensors on "meta" cannot be copied to
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = printable(error)[:200]
        raise CheckpointError(
            f"{path}: header and weights do not fit ({reason}); train it again"
        ) from None
    return network.eval(), grid, metadata


def check_own(path: str | Path, trusted: Collection[str], *names: str) -> None:
    """Check that a file names no own code besides what the user trusts.

    A stranger's file may name any module, and importing one runs it.

    Args:
        path: The file, for the message.
        trusted: Own code that the user named, each as ``module:Object``.
        names: Names in the file; those of scenegen itself always pass.

    Raises:
        CheckpointError: if own code in `names` is not in `trusted`.
    """
    needed = {name for name in names if is_own(name)}
    if not needed <= set(trusted):
        spelled = printable(",".join(sorted(needed.union(trusted))))[:200]
        raise CheckpointError(
            f"{path}: is made of {spelled}, which is imported only if you name it; if you trust "
            f"that code, give the network as {spelled}@{path}"
        )


def current_settings(network: Json) -> Json:
    """Update the settings of a network to this version.

    Versions up to 0.2.0 wrote a stem stride, and had no targets.

    Args:
        network: Settings as any version wrote them; not changed.

    Returns:
        Settings with the fields of `NetworkConfig`.

    Raises:
        ValueError: if the network has a stem that this version does not build.
    """
    network = {"targets": [], "channels": [], **network}
    if (stride := network.pop("stem_stride", STEM_STRIDE)) != STEM_STRIDE:
        raise ValueError(f"stem_stride = {short_repr(stride)}: networks have {STEM_STRIDE}")
    return network


def network_from(header: Json) -> tuple[NetworkConfig, GridSpec]:
    """Read the network's settings and its grid from a header. Nothing is imported.

    Args:
        header: Header of a network's file.

    Returns:
        Settings and grid.

    Raises:
        KeyError, TypeError, ValueError: if the header is damaged, or the network does not take
            maps on the grid, or takes too much memory for them.
    """
    config = NetworkConfig(**current_settings(header["network"]))
    grid = GridSpec(**{**header["grid"], "shape": tuple(header["grid"]["shape"])})
    config.check_map(grid.shape)
    return config, grid
