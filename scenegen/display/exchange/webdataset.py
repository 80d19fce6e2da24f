"""WebDataset's tar files, for loaders that stream: github.com/webdataset/webdataset, "The
WebDataset format"."""

import io
import json
import tarfile

from lidarsim import GridSpec, Sensor
from scenegen.display.exchange.choices import Choices
from scenegen.display.exchange.clouds import Npz
from scenegen.sample import Sample


class WebDataset:
    """``train-000000.tar`` with the first samples, and so on; each is ``000007.npz``, as the format
    `npz` has it, and ``000007.json``, who it is."""

    together = 100

    def __init__(self, choices: Choices):
        self._npz = Npz(choices)

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """The file that begins with a sample."""
        return (f"{split}-{number // self.together:06d}.tar",)

    def encode(
        self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor
    ) -> tuple[bytes, ...]:
        """Its content: the same bytes whenever it is made."""
        memory = io.BytesIO()
        with tarfile.open(fileobj=memory, mode="w", format=tarfile.USTAR_FORMAT) as file:
            for number, sample in samples:
                who = {
                    "number": number,
                    "world": int(sample.world),
                    "viewpoint": int(sample.viewpoint),
                }
                (arrays,) = self._npz.encode(sample, grid, lidar)
                for ending, content in (("npz", arrays), ("json", json.dumps(who).encode())):
                    member = tarfile.TarInfo(f"{number:06d}.{ending}")
                    member.size = len(content)
                    file.addfile(member, io.BytesIO(content))
        return (memory.getvalue(),)
