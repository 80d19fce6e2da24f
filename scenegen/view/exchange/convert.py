"""A dataset's samples, one after another, into a folder in another format; a stopped run goes on where it was."""

import contextlib
import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenegen.dataset.read import Dataset, Split
from scenegen.errors import DatasetError, printable
from scenegen.files import disk_error, make_parent, write_whole
from scenegen.sample import Sample
from scenegen.view.exchange.choices import Choices

STATE = "convert.json"
"""What a folder was converted from, and how."""


@dataclass(frozen=True)
class Converted:
    """What a run did."""

    written: int
    there: int
    """Samples that an earlier run had written."""
    broken: tuple[str, ...]
    """A line for each sample that could not be read."""


def convert(
    dataset: Dataset,
    out: Path,
    *,
    to: str,
    form: Any,
    choices: Choices,
    splits: Sequence[str],
    on_start: Callable[[int], None] = lambda total: None,
    on_sample: Callable[[int], None] = lambda count: None,
) -> Converted:
    """Write every sample of `splits` as the format `form`, called `to`, has it.

    What is there already is passed over. Each file appears whole or not at all; the disk is trusted to
    keep it, unlike a dataset's. Raises DatasetError where `out` holds another conversion, or the disk refuses.
    """
    _claim(dataset, out, to, choices)
    on_start(sum(len(dataset.split(split)) for split in splits))
    written, there, broken = 0, 0, list[str]()
    made: set[Path] = set()
    together = getattr(form, "together", None)
    for split in splits:
        samples = dataset.split(split)
        for first in range(0, len(samples), together or 1):
            numbers = range(first, min(first + (together or 1), len(samples)))
            paths = [out / name for name in form.names(split, first)]
            if all(path.exists() for path in paths):
                there += len(numbers)
            else:
                found, lines = _sound(samples, numbers, checked=bool(together))
                broken += lines
                try:
                    given: Any = list(found.items()) if together else found.get(first)
                    contents = form.encode(given, dataset.grid, dataset.lidar) if found else ()
                except (DatasetError, ValueError) as error:
                    broken += [f"{split} {number} is left out: {printable(error)}" for number in found]
                else:
                    for path, content in zip(paths, contents, strict=bool(found)):
                        if path.parent not in made:
                            make_parent(path)
                            made.add(path.parent)
                        _put(path, content)
                    written += len(found)
            on_sample(len(numbers))
    return Converted(written, there, tuple(broken))


def _sound(samples: Split, numbers: range, *, checked: bool) -> tuple[dict[int, Sample], list[str]]:
    """Samples by number, and a line for each that cannot be read; with `checked`, every field of them is read here."""
    found, lines = dict[int, Sample](), list[str]()
    for number in numbers:
        try:
            sample = samples[number]
            for name in sample.names if checked else ():
                getattr(sample, name)
            found[number] = sample
        except (DatasetError, ValueError) as error:
            lines.append(f"{samples.name} {number} is left out: {printable(error)}")
    return found, lines


def _claim(dataset: Dataset, out: Path, to: str, choices: Choices) -> None:
    """Say in `out` what it holds. Raises DatasetError where it holds something else."""
    manifest = dataset.manifest
    about = {
        "format": to,
        "choices": dataclasses.asdict(choices),
        "dataset": manifest.fingerprint,
        "digest": manifest.digest,
        "grid": manifest.parameters["grid"],
    }
    content = json.dumps(about, indent=1).encode()
    state = out / STATE
    if state.exists():
        if state.read_bytes() != content:
            raise DatasetError(f"{out}: holds another dataset or another conversion; choose another folder")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out}: is there, and no conversion of ours; choose another folder")
    make_parent(state)
    write_whole(state, content)


def _put(path: Path, content: bytes) -> None:
    """Put `content` at `path`, whole or not at all, without waiting for the disk."""
    draft = path.with_name(f".{path.name}.part")
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise disk_error(path, error) from None
