"""What a file of predictions, a run, or a network is, in a few figures."""

from pathlib import Path

import h5py
import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from lidarsim import GridSpec
from scenegen.dataset.hdf5 import read_guarded
from scenegen.errors import DatasetError, printable
from scenegen.files import Json
from scenegen.model.completion.protocol import PARTS, SURE
from scenegen.model.config import VARIANTS, NetworkConfig
from scenegen.model.network import Network


def cost(config: NetworkConfig, shape: tuple[int, int, int]) -> Json:
    """What a network costs for one map of `shape`, counted by running it once.

    `macs` are multiply-accumulates of a forward pass: convolutions, linear layers, attention;
    `activation_bytes` is what a training step keeps for its backward pass, float32.
    """
    network = Network(config).train()
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept.setdefault(storage.data_ptr(), storage.nbytes())
        return tensor

    for parameter in network.parameters():  # weights are kept anyway
        kept[parameter.untyped_storage().data_ptr()] = 0
    counter = FlopCounterMode(display=False)
    maps = {name: torch.zeros(1, *shape) for name in config.inputs}
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), counter:  # fused attention is not counted
        network(maps)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        network(maps)
    return {
        "variant": config.variant,
        "stem_stride": config.stem_stride,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "macs": counter.get_total_flops() // 2,
        "activation_bytes": sum(kept.values()),
    }


def costs() -> list[Json]:
    """The costs of all variants with both stems, for maps of the usual grid."""
    return [
        cost(NetworkConfig(variant=variant, stem_stride=stride), GridSpec().shape)
        for stride in (2, 1)
        for variant in VARIANTS
    ]


def prediction_facts(path: Path) -> Json:
    """An HDF5 file of predictions, of a split or of one scan: who made them, and what is in it.
    Raises DatasetError."""
    return read_guarded(_facts, path, 1 << 62)


def _facts(path: Path) -> Json:
    try:
        with h5py.File(path, "r") as file:
            about = {
                name: printable(file.attrs[name])[:100]
                for name in ("method", "split", "dataset")
                if name in file.attrs
            }
            parts = {name: list(file[name].shape) for name in (*PARTS, *SURE) if name in file}
            if "occupancy" in file:  # the truth, which no predictions hold
                raise DatasetError(
                    f"{path}: is a shard of a dataset; inspect its folder, {path.parent}"
                )
    except DatasetError:
        raise
    except Exception as error:  # h5py's errors share no base
        raise DatasetError(f"{path}: cannot be read as HDF5: {printable(error)[:200]}") from None
    if not parts:
        raise DatasetError(f"{path}: holds no predictions; expected {' or '.join(PARTS)}")
    return {
        "predictions": str(path),
        **about,
        "of": "a split" if "split" in about else "a scan",
        "arrays": parts,
    }


def run_facts(folder: Path) -> Json:
    """A training run's folder: what was trained on what, and how far it came. Raises
    DatasetError."""
    from scenegen.model.training.card import read_rows
    from scenegen.model.training.run_folder import ROWS, RunFolder, kept

    settings = RunFolder(folder).settings()
    rows = read_rows(folder / ROWS)
    best = kept(rows, "loss")
    network = settings["network"]
    return {
        "run": str(folder),
        "network": network["variant"],
        "inputs": network["inputs"],
        "kinds": settings["kinds"],
        "samples": settings["samples"],
        "epochs": len(rows),
        "best": {name: best[name] for name in ("epoch", "val_loss", "val_iou", "val_near_mae")},
    }
