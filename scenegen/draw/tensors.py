"""Samples as a PyTorch dataset of dictionaries of tensors, which the default collate can batch."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from lidarsim.parameters import short_repr
from scenegen.base.errors import DatasetError
from scenegen.draw.movers import OVER_TIME, field_of


class TensorSamples(Dataset[dict[str, torch.Tensor]]):
    """A map-style dataset: sample number → tensors by field name.

    It can be pickled and read in any process. Tensors are copies with the types of the fields,
    except that classes (uint16) become int32: torch supports few operations on uint16.
    """

    def __init__(self, samples: Any, names: Sequence[str]):
        self.samples, self.names = samples, tuple(names)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, torch.Tensor]]:
        """Read several samples; torch calls this for a batch."""
        return [
            {name: _tensor(field_of(sample, name)) for name in self.names}
            # read together: a stream draws their units in parallel
            for sample in self.samples.__getitems__(indices)
        ]

    def __repr__(self) -> str:
        return f"<TensorSamples: {', '.join(self.names)} of {self.samples}>"


def tensors_of(samples: Any, fields: Sequence[str] | str | None) -> TensorSamples:
    """Make a dataset of tensors; see `scenegen.draw.sample.SampleSequence.torch`.

    Args:
        samples: The `SampleSequence`.
        fields: Names of the fields, or None for all.

    Raises:
        DatasetError: if a field does not exist, or its shape differs between samples.
    """
    known, schemas = samples.schema.names, samples.schemas
    # the least of all sources: a batch may have samples of each
    after_s = min(schema.after_s for schema in schemas)
    shapes = {
        name: {schema.shape(name) if name in schema.names else None for schema in schemas}
        for name in known
    }
    names = known if fields is None else (fields,) if isinstance(fields, str) else tuple(fields)
    for name in names:
        if match := OVER_TIME.fullmatch(str(name)):
            if after_s < float(match[2] or 0):
                raise DatasetError(
                    f"{samples}: torch() has no field {name}: courses of movers are stored for "
                    f"{max(after_s, 0):g} s; generate it with --movers, and with a longer after_s"
                )
        elif name not in known:
            raise DatasetError(
                f"{samples}: torch() has no field {short_repr(name)}; expected {', '.join(known)}"
            )
        # fields over time have the shape of the grid, as `occupancy` has
        if len(shapes["occupancy" if match else name]) > 1:
            alike = [field for field in known if len(shapes[field]) == 1]
            raise DatasetError(
                f"{samples}: torch(): {name} has several shapes, which make no batch; give "
                f"fields={alike}, or some of them"
            )
    return TensorSamples(samples, names)


def _tensor(value: Any) -> torch.Tensor:
    array = np.asarray(value)
    return torch.tensor(array.astype(np.int32) if array.dtype == np.uint16 else array)
