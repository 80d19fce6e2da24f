"""Samples as a dataset of torch's: dictionaries of tensors, which its default collate batches."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from scenegen.base.errors import DatasetError, short


class TensorSamples(Dataset[dict[str, torch.Tensor]]):
    """A map-style dataset: sample number → name of each field → its tensor.

    It can be pickled, and read in any process, as the samples themselves. Tensors are copies. Types
    are those of the fields; torch has few operations for uint16, so classes become int32.
    """

    def __init__(self, samples: Any, names: Sequence[str]):
        self.samples, self.names = samples, tuple(names)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, torch.Tensor]]:
        """Several samples, as torch asks for a batch."""
        return [
            {name: _tensor(getattr(sample, name)) for name in self.names}
            for sample in self.samples.__getitems__(indices)
        ]

    def __repr__(self) -> str:
        return f"<TensorSamples: {', '.join(self.names)} of {self.samples}>"


def tensors_of(samples: Any, fields: Sequence[str] | str | None) -> TensorSamples:
    """`samples` as tensors: see `scenegen.draw.sample.Samples.torch`.

    Raises:
        DatasetError: There is no such field, or samples differ in its shape.
    """
    known, schemas = samples.schema.names, samples.schemas
    shapes = {
        name: {schema.shape(name) if name in schema.names else None for schema in schemas}
        for name in known
    }
    names = known if fields is None else (fields,) if isinstance(fields, str) else tuple(fields)
    for name in names:
        if name not in known:
            raise DatasetError(
                f"{samples}: torch() has no field {short(name)}; expected {', '.join(known)}"
            )
        if len(shapes[name]) > 1:
            alike = [other for other in known if len(shapes[other]) == 1]
            raise DatasetError(
                f"{samples}: torch(): {name} has several shapes, which make no batch; give "
                f"fields={alike}, or some of them"
            )
    return TensorSamples(samples, names)


def _tensor(value: Any) -> torch.Tensor:
    array = np.asarray(value)
    return torch.tensor(array.astype(np.int32) if array.dtype == np.uint16 else array)
