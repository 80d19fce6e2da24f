"""How large a study is. Nothing heavy is imported here: the command line reads its options here."""

from dataclasses import dataclass

from lidarsim.parameters import check, number
from scenegen.limits import MOST_MAPS, MOST_SEED


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig:
    """The size of a study. At scale 1 it is the paper's in samples and trials."""

    scale: float = number(1.0, above=0, most=1)
    """Share of all samples, maps and trials."""
    maps: int = number(20_000, least=1, most=MOST_MAPS)
    """Maps that every network sees, at scale 1."""
    seed: int = number(0, least=0, most=MOST_SEED)
    """Seed of the datasets, the goals and the intervals."""
    only: tuple[str, ...] = ()
    """Names of runs; all of them where none is named."""

    def __post_init__(self) -> None:
        check(self)

    def scaled(self, count: int) -> int:
        """`count` at this scale, at least 1."""
        return max(round(count * self.scale), 1)

    @property
    def counts(self) -> dict[str, int]:
        """Samples of every kind, by split."""
        return {"train": self.scaled(2500), "val": self.scaled(250), "test": self.scaled(500)}
