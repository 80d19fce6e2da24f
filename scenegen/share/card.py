"""The dataset card, `README.md`: front matter that the Hub reads, and what a person wants to know.
`card.md` is its text; here are the parts that differ between datasets."""

import json
from collections.abc import Mapping
from importlib.resources import files
from string import Template
from typing import Any

from scenegen.display.inspect import LABELS
from scenegen.share.publication import LOCK, PAPER, Publication
from scenegen.share.regenerate import ORIGINAL, source_file

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
"""Samples below which the Hub's size category is this."""
MOST_NAMED = 50
"""Classes that a card names."""


def card(it: Publication) -> str:
    """The whole card."""
    template = Template((files("scenegen.share") / "card.md").read_text(encoding="utf-8"))
    made, told, samples = it.manifest, it.statistics, it.statistics["samples"]
    text = template.substitute(
        _notes(it),
        json_name=json.dumps(it.name),
        hub_licence=it.licence.hub,
        size=next((name for most, name in SIZES if samples < most), "1M<n<10M"),
        data_files="\n".join(
            f'  - split: {split}\n    path: "{split}-*.h5"' for split in it.splits
        ),
        name=it.name,
        sentence=it.sentence,
        seed=made.seed,
        pictures=_pictures(it),
        fields=_fields(it),
        voxel_m=f"{made.grid.voxel_m:g}",
        exact_voxel_m=repr(made.grid.voxel_m),
        truncation_m=f"{made.grid.truncation_m:g}",
        lidar=made.lidar,
        repository=it.repository,
        tag=it.tag,
        first=made.shards[0].file,
        split=it.splits[0],
        statistics=_statistics(it),
        measured=", ".join(f"{told['splits'][name]['sampled']} of {name}" for name in it.splits),
        megabytes=f"{told['bytes'] / 1e6:.0f}",
        kilobytes=f"{told['bytes_per_sample'] / 1e3:.0f}",
        command=it.command,
        versions=", ".join(f"{name} {number}" for name, number in made.software.items()),
        lock=LOCK,
        digest=made.digest,
        checks="\n".join(f"- {name}: {detail}" for name, detail in it.checks),
        licence=it.licence.name,
        licence_url=it.licence.url,
        paper=PAPER,
        key=it.name.replace("-", "_"),
        samples=samples,
        owner=it.repository.partition("/")[0],
        year=it.date[:4],
        url=it.url,
    )
    return text.replace("\n\n\n\n", "\n\n")  # where there are no pictures


def _notes(it: Publication) -> dict[str, str]:
    """Sentences that stand in the cards of some datasets only."""
    made = it.manifest
    absent = [f"`{name}`" for name in ("free", "tudf") if name not in it.fields]
    notes = {
        "surfaces": "",
        "derived": "",
        "stands": "",
        "follows": f"every sample follows from the seed and `{source_file(made)[0]}`",
        "faults": "no noise, no motion during a turn, no return lost within range",
        "rejected": f" Rejected while drawing: {_rejected(made.rejected)}.",
    }
    if made.grid.hollow:
        notes["surfaces"] = (
            " Truth is of surfaces: a voxel that lies wholly inside one solid is not occupied."
        )
    if absent:
        notes["derived"] = (
            f" {' and '.join(absent)} follow from these; scenegen derives them on reading."
        )
    if made.noise is not None:
        notes["faults"] = f"its noise is simulated, `{made.noise['stages']}`"
    if made.rescan is not None:
        notes["rejected"] = ""
        notes["follows"] = (
            "the worlds and poses of another dataset were scanned again by the sensor in "
            f"`{source_file(made)[0]}`"
        )
        notes["stands"] = (
            f"\n`{ORIGINAL}` stands for that dataset, whose digest is `{made.rescan['digest']}`.\n"
        )
    elif made.kind == "scene":
        notes["stands"] = (
            "\n`SCENES` stands for the MJCF files whose names and digests `dataset.json` lists "
            "under `recipe`.\n"
        )
    return notes


def _rejected(counts: Mapping[str, Mapping[str, int]]) -> str:
    told = (
        f"{what}: {', '.join(f'{reason} {count}' for reason, count in reasons.items())}"
        for what, reasons in counts.items()
        if reasons
    )
    return "; ".join(told) or "none"


def _pictures(it: Publication) -> str:
    if not it.pictures:
        return ""
    shown = "\n\n".join(f"![{caption}]({name})" for name, caption in it.pictures)
    text = (
        f"{shown}\n\nFrom left to right: what the scan observed, what is there (both coloured by "
        "height), and how far the nearest occupied voxel is, in the level just below the sensor, "
        f"from dark (0 m) to light ({it.manifest.grid.truncation_m:g} m). The dot is the sensor. "
        f"Shown are {', '.join(caption for _, caption in it.pictures)}."
    )
    if it.page:
        text += (
            f"\n\nMore samples in three dimensions: download [{it.page}]({it.page}), and open it "
            "in a browser."
        )
    return text


def _table(*rows: list[str]) -> str:
    """A table in Markdown; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def _fields(it: Publication) -> str:
    rows = [["field", "type, shape of a sample", "unit", "meaning"]]
    for name, field in it.fields.items():
        shape = " × ".join(map(str, field["shape"]))
        kind = f"{field['dtype']} ({shape})" if shape else field["dtype"]
        rows.append([f"`{name}`", kind, field["unit"] or "–", field["meaning"]])
    table = _table(*rows)
    if it.manifest.labels is not None:
        classes = it.manifest.labels["classes"]
        more = f" and {len(classes) - MOST_NAMED} more" if len(classes) > MOST_NAMED else ""
        table += f"\n\nClasses, from 0: {', '.join(map(json.dumps, classes[:MOST_NAMED]))}{more}."
    return table


def _statistics(it: Publication) -> str:
    splits: Mapping[str, Any] = {name: it.statistics["splits"][name] for name in it.splits}
    rows = [["", *splits]]
    rows += [
        [key, *(str(split[key]) for split in splits.values())] for key in ("samples", "worlds")
    ]
    for key, (label, unit, factor) in LABELS.items():
        values = [split["statistics"][key] for split in splits.values()]
        cells = [
            f"{value['mean'] * factor:.2f} ± {value['std'] * factor:.2f}"
            if value["mean"] is not None
            else "–"
            for value in values
        ]
        rows.append([f"{label}, {unit}", *cells])
    return _table(*rows)
