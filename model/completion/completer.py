"""A trained network as one object: partial maps in, predictions out.

completer = Completer.from_pretrained("proposed")
prediction = completer(observed)  # (80, 80, 40) or (B, 80, 80, 40), bool
prediction.occupancy_probability, prediction.tudf  # the same shape, float32; metres
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidarsim import GridSpec
from scenegen.dataset.locate import client_output, without_tokens
from scenegen.errors import needs
from scenegen.model.checkpoint import CheckpointError, load_network
from scenegen.model.completion.protocol import Prediction, check_prediction
from scenegen.model.network import Output
from scenegen.model.runtime import load_onnx

BUNDLED = Path(__file__).parents[1] / "weights"
"""Where the networks lie that come with scenegen."""
HUB = "hf://"
NAMES_IN_FOLDER = ("best.safetensors", "scenegen.model.safetensors")
"""What a run's folder, or a repository, calls its network."""


class Completer:
    """A network with the grid it was trained on. It is a `MapCompleter`, too, so it can be a row of the bench."""

    def __init__(
        self,
        forward: Callable[[Tensor], Output],
        grid: GridSpec,
        *,
        name: str,
        about: Mapping[str, Any] | None = None,
        batch: int = 8,
    ):
        self.grid = grid
        self.name = name
        """How the network is called in tables."""
        self.about = dict(about or {})
        """What is known of its training: settings, versions, validation figures."""
        self._forward = forward
        self._batch = batch

    @classmethod
    def from_pretrained(
        cls, name: str | Path, *, device: str | torch.device = "cpu", batch: int = 8, threads: int = 0
    ) -> "Completer":
        """The network called `name`: one that comes with scenegen ("proposed", "occ", "tudf"), a .safetensors file, a
        run's folder, an .onnx file, which runs on the CPU, or ``hf://user/name[@revision]``, which alone is fetched.

        At most `batch` maps are completed at once; an .onnx file runs on `threads` threads, 0 for all. Raises
        CheckpointError where there is none, or it is damaged.
        """
        path = locate(name)
        title = called(name, path)
        if path.suffix == ".onnx":
            run, grid, about = load_onnx(path, threads=threads)
            return cls(run, grid, name=title, about=about, batch=batch)
        network, grid, about = load_network(path)
        network.to(device, memory_format=torch.channels_last_3d)

        def forward(observed: Tensor) -> Output:
            return Output(*network(observed.to(device).float()))

        return cls(forward, grid, name=title, about=about, batch=batch)

    def __call__(self, observed: NDArray[Any] | Tensor) -> Prediction:
        """Complete one map, (*grid.shape), or a batch of them, (B, *grid.shape), from their observed voxels.

        Numbers 0 and 1, or bool. What comes back has the same shape and is float32, numpy for numpy and torch for
        torch (where `observed` is); distances are metres, at most the truncation; what the network's variant does not
        predict is None. Raises ValueError for another grid, or for values that are neither 0 nor 1; PredictionError
        where the network says NaN, or what is no probability or distance.
        """
        given = observed if isinstance(observed, Tensor) else torch.from_numpy(np.ascontiguousarray(observed))
        if given.shape[-3:] != self.grid.shape or given.ndim not in (3, 4):
            raise ValueError(
                f"observed has shape {tuple(given.shape)}, expected {self.grid.shape} or (B, *{self.grid.shape}): "
                f"{self.name} completes maps of voxels of {self.grid.voxel_m} m, indexed x, y, z"
            )
        if given.dtype != torch.bool and not ((given == 0) | (given == 1)).all():
            raise ValueError("observed holds values other than 0 and 1; give the voxels that hold a return")
        maps = given.reshape(-1, *self.grid.shape)
        if not len(maps):
            raise ValueError("observed holds no map; give at least one")
        parts = [self._complete(part) for part in maps.split(self._batch)]
        joined = [
            None if part[0] is None else torch.cat(part).reshape(given.shape) for part in zip(*parts, strict=True)
        ]
        check_prediction(Prediction(*joined), tuple(given.shape), self.name)
        if isinstance(observed, Tensor):
            return Prediction(*(None if part is None else part.to(observed.device) for part in joined))
        return Prediction(*(None if part is None else part.numpy(force=True) for part in joined))

    def complete(self, observed: NDArray[np.bool_], free: NDArray[np.bool_], *, grid: GridSpec) -> Prediction:
        """See `MapCompleter.complete`; `free` is not looked at. Raises ValueError for another grid."""
        if grid != self.grid:
            raise ValueError(f"{self.name} completes maps on {self.grid}, these are on {grid}")
        return self(observed)

    @torch.inference_mode()
    def _complete(self, observed: Tensor) -> tuple[Tensor | None, Tensor | None]:
        output = self._forward(observed)
        probability = None if output.logits is None else output.logits.sigmoid()
        tudf = None if output.tudf is None else output.tudf.clamp(max=self.grid.truncation_m)
        return probability, tudf


def called(name: str | Path, path: Path) -> str:
    """What the network `name`, found at `path`, is called in tables: by its file, its run, or its repository."""
    if str(name).startswith(HUB):
        return str(name).removeprefix(HUB).partition("@")[0].rpartition("/")[2]
    return path.resolve().parent.name if path.name in NAMES_IN_FOLDER else path.stem


def bundled() -> list[str]:
    """Names of the networks that come with scenegen."""
    return sorted(path.stem for path in BUNDLED.glob("*.safetensors"))


def locate(name: str | Path) -> Path:
    """The file of the network called `name`; see `Completer.from_pretrained`.

    Raises CheckpointError where there is none. Only names that begin with ``hf://`` reach for the network.
    """
    if str(name).startswith(HUB):
        return _fetch(str(name))
    if str(name) in bundled():
        return BUNDLED / f"{name}.safetensors"
    path = Path(name)
    if path.is_dir():
        for inside in NAMES_IN_FOLDER:
            if (path / inside).is_file():
                return path / inside
        raise CheckpointError(f"{path}: a folder without {' or '.join(NAMES_IN_FOLDER)}; give a run's folder or a file")
    if path.is_file():
        return path
    hint = f"; a repository on the Hub is {HUB}{name}" if re.fullmatch(r"[\w.-]+/[\w.-]+", str(name)) else ""
    known = f"known names are {', '.join(bundled())}" if bundled() else "none comes with this scenegen"
    raise CheckpointError(f"{name}: no such network: {known}; or give a .safetensors file, or a run's folder{hint}")


def _fetch(name: str) -> Path:
    """A repository's network, through the Hub's cache."""
    repository, _, revision = name.removeprefix(HUB).partition("@")
    try:
        from huggingface_hub import hf_hub_download
    except ImportError:
        raise CheckpointError(f"{name}: {needs('huggingface_hub', 'publish')}") from None
    try:
        with client_output(shown=False):
            return Path(hf_hub_download(repository, NAMES_IN_FOLDER[1], revision=revision or None))
    except Exception as error:  # its errors share no base
        raise CheckpointError(f"{name}: cannot be fetched: {without_tokens(error)}") from None
