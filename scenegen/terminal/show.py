"""Results as people read them. All that comes from files is escaped here, in `say` and `show_table`."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rich_click as click

from scenegen.errors import escaped


def say(text: object = "") -> None:
    """Print lines; control characters in them are escaped."""
    for line in str(text).split("\n"):
        click.echo(escaped(line))


def show_table(rows: Mapping[str, Any], title: str = "", marks: Mapping[str, tuple[str, str]] | None = None) -> None:
    """A line for each of `rows`, name and value; `marks` stand before the values, text and colour by name."""
    if title:
        say(f"\n{escaped(title)}")
    width = max((len(escaped(name)) for name in rows), default=0)
    for name, value in rows.items():
        text, colour = (marks or {}).get(name, ("", "reset"))
        mark = f"{click.style(text, fg=colour)}  " if text else ""
        click.echo(f"{click.style(escaped(name).ljust(width), bold=True)}  {mark}{escaped(value)}")


def show_plan(plan: Any, as_json: bool) -> None:
    """What `generate` would make."""
    rows = {
        "folder": str(plan.folder),
        "samples": plan.samples,
        "shards": len(plan.shards),
        "bytes_expected": plan.bytes_expected,
        "parameters": plan.parameters,
    }
    if as_json:
        print(json.dumps(rows))
    else:
        show_table(flat(rows), "would make")


def show_summary(summary: Any, seconds: float) -> None:
    """What `generate` made."""
    present = sum(summary.samples.values())
    rows = {
        "folder": summary.folder,
        "samples": f"{present}  ({_per_split(summary.samples)})",
        "worlds": f"{sum(summary.worlds.values())}  ({_per_split(summary.worlds)})",
        "rejected": _rejections(summary.rejected),
        "size": f"{summary.bytes / 1e6:.1f} MB, {summary.bytes / max(present, 1) / 1e3:.1f} KB a sample",
        "time": f"{seconds:.1f} s, {summary.samples_written / seconds:.0f} samples a second, start-up included",
        "digest": summary.digest or f"none yet: {summary.shards_missing} of {summary.shards} shards are missing",
        "next": f"scenegen inspect {summary.folder}",
    }
    show_table(rows)


def show_report(report: Any, seconds: float) -> None:
    """What `verify` found."""
    rows, marks = {}, {}
    for check in report.checks:
        verdict = "FAILED " if not check.ok else "skipped" if check.skipped else "ok     "
        marks[check.name] = verdict, "red" if not check.ok else "yellow" if check.skipped else "green"
        rows[check.name] = f"{check.seconds:7.2f} s  {check.detail}"
    show_table(rows, marks=marks)
    say(f"\n{report.samples} samples in {seconds:.1f} s, {report.samples / seconds:.0f} a second")


def show_published(done: Any, seconds: float, as_json: bool) -> None:
    """What `publish` made, and sent."""
    staged = done.staged
    url = f"https://huggingface.co/datasets/{staged.repository}/tree/{staged.tag}"
    size = sum(staged.files.values())
    if as_json:
        rows = {"folder": str(staged.folder), "repository": staged.repository, "tag": staged.tag, "commit": done.commit}
        print(json.dumps({**rows, "digest": staged.digest, "files": staged.files, "bytes": size, "seconds": seconds}))
        return
    if done.commit is None:
        show_table({name: f"{size:>12,}" for name, size in staged.files.items()}, "would send, in bytes")
    show_table(
        {
            "folder": staged.folder,
            "files": f"{len(staged.files)}, {size / 1e6:.1f} MB",
            "revision": f"hf://{staged.repository}@{staged.tag}",
            "time": f"{seconds:.1f} s",
            **({"next": "the same command without --dry-run"} if done.commit is None else {"page": url}),
        },
        "published" if done.commit else "ready",
    )


def show_inspection(dataset: Path | str, found: dict[str, Any]) -> None:
    """What `inspect` found."""
    show_table(
        {
            "dataset": dataset,
            "kind": found["kind"],
            "seed": found["seed"],
            "complete": "yes" if found["complete"] else "no",
            "digest": found["digest"],
            "grid": f"{found['grid']['shape']} voxels of {found['grid']['voxel']} m",
            "fields": ", ".join(found["fields"]),
            "samples": found["samples"],
            "size": f"{found['bytes'] / 1e6:.1f} MB, {found['bytes_per_sample'] / 1e3:.1f} KB a sample",
            "rejected": _rejections(found["rejected"]),
        },
    )
    units = {"range_m": ("mean range", "m", 1), "tudf_m": ("mean distance", "m", 1)}
    for name, split in found["splits"].items():
        rows = {}
        for key, value in split["statistics"].items():
            label, unit, factor = units.get(key, (key, "%", 100))
            mean, std, low, high = (None if value[name] is None else value[name] * factor for name in value)
            rows[label] = "–" if mean is None else f"{mean:6.2f} ± {std:5.2f} {unit}   from {low:.2f} to {high:.2f}"
        title = f"{name}: {split['samples']} samples of {split['worlds']} worlds ({split['sampled']} measured)"
        show_table(rows, title)


def _per_split(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _rejections(rejected: dict[str, dict[str, int]]) -> str:
    parts = [f"{what} {_per_split(counts)}" for what, counts in rejected.items() if counts]
    return "; ".join(parts) or "none"


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, names joined by dots."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found
