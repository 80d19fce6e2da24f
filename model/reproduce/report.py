"""The study for people, as text and pictures, from what `study.json` holds and nothing else."""

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.statistics import caution, head, interval, line
from scenegen.model.evaluation.study import figures as of_bench
from scenegen.model.evaluation.study.report import brief, fate_lines, success_lines, threshold_lines
from scenegen.model.reproduce.claims import PATIENCE, seeded

SHOWN = {"reconstruction": ("iou", "near_rmse"), "planning": ("success",)}
"""The figures of every row; all others stand in the JSON."""


def to_markdown(study: Mapping[str, Any]) -> str:
    """Verdicts, then the figures behind them."""
    settings, runs = study["settings"], study["runs"]
    devices = ", ".join(sorted({run["device"] for run in runs.values()}))
    hours = sum(run["hours"] for run in runs.values())
    lines = [
        "# The study",
        "",
        f"{len(runs)} networks at scale {settings['scale']:g}; the whole budget is "
        f"{settings['maps'] * settings['scale']:.0f} maps seen. They were trained in {hours:.1f} "
        f"hours on {devices}; "
        f"they were measured at commit {study['commit']}. Written by `scenegen reproduce`; "
        f"`study.json` holds every "
        "figure of this page, and many more.",
    ]
    if study["missing"]:
        lines += [
            "",
            f"**Not trained yet**, so that verdicts do without them: {_names(study['missing'])}.",
        ]
    lines += [
        "",
        "## Verdicts",
        "",
        "A claim is that one of the paper's methods is better than another by one metric on one "
        "kind of worlds: one "
        "for every bold cell of its tables and every other row. It is confirmed, or contradicted, "
        "where the mean "
        "difference over all seeds, two of each method at least, is told from chance in worlds "
        "and in training seeds "
        "at a level of .05 for all claims together (Holm); else it is undecided. A claim is "
        "refuted only by networks "
        f"that went on for {PATIENCE} epochs without a lower validation loss, as the paper's "
        f"early stopping asks; "
        f"contradicted by others, that may yet turn.{_epochs(runs)}",
        "",
        *head(("verdict", "claims")),
    ]
    for name, said in study["verdicts"].items():
        lines.append(
            line(f"{name}: {said['asks']}", (f"**{said['verdict']}**", _counts(said["claims"])))
        )
    for kind in study["report"]["reconstruction"]:
        lines += ["", f"## {kind}", ""]
        lines += (
            [f"**{few}.**", ""]
            if (few := caution(study["report"]["datasets"][kind]["worlds"]))
            else []
        )
        for title, claims in (
            ("The paper's claims", study["claims"]),
            ("Those about paths again, where both methods of a pair have one", study["paths"]),
            ("Beside them, judged alike", study["beside"]),
        ):
            rows = [claim for claim in claims if claim["kind"] == kind]
            tried = [claim for claim in rows if claim["pairs"]]
            lines += [f"{title}; {len(rows) - len(tried)} of {len(rows)} have no networks yet:", ""]
            lines += [
                *head(("verdict", "chance (Holm)", "better by", "pair by pair")),
                *_judged(tried),
                "",
            ]
        lines += [
            "Means over test maps and trials, with 95 % intervals:",
            "",
            *_means(study["report"], kind),
        ]
        if studied := study["report"].get("study", {}).get(kind):
            lines += [
                *success_lines(studied, "search"),
                *success_lines(studied, "clearance_weight"),
                *threshold_lines(studied),
                *fate_lines(studied),
            ]
        compared = [row for row in study["contrasts"] if row["kind"] == kind]
        if study["short"]["reconstruction"][kind]:
            lines += [
                "",
                "Runs with a part of the budget, one seed:",
                "",
                *_means(study["short"], kind),
            ]
        for name, there in study["elsewhere"].items():
            lines += [
                "",
                f"`{name}`: {there['asks']}; runs with a part of the budget, one seed:",
                "",
            ]
            lines += _means(there["report"], kind)
        if compared:
            lines += [
                "",
                "How much better than the run that they are compared with:",
                "",
                *_compared(compared),
            ]
    lines += ["", "## Runs", "", *head(("what for", "maps, hours", "weights"))]
    for name, run in runs.items():
        spent = f"{run['maps']:.0f} of {run['samples']}, {run['hours']:.1f}"
        lines.append(line(f"`{name}`", (run["asks"], spent, f"{run['sha256'][:12]}…")))
    return "\n".join(lines) + "\n"


def _means(report: Mapping[str, Any], kind: str) -> list[str]:
    columns = [(table, name) for table, names in SHOWN.items() for name in names]
    titles = head([_label(name) for _, name in columns])
    rows = report["reconstruction"][kind]
    return [
        *titles,
        *(
            line(row, (brief(report[table][kind][row][name]) for table, name in columns))
            for row in rows
        ),
    ]


def _judged(claims: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    for claim in claims:
        name = f"{_label(claim['metric'])}: {claim['best']} before {claim['other']}"
        chance = "" if claim["holm"] is None else f"{claim['holm']:.4f}"
        yield line(
            name,
            (
                claim["verdict"],
                chance,
                _gain(claim),
                "; ".join(_signed(one) for one in claim["pairs"]),
            ),
        )


def _compared(rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    found: dict[str, list[str]] = {}
    for row in rows:
        found.setdefault(f"{row['run']} than {row['against']}", []).append(_gain(row))
    metrics = dict.fromkeys(row["metric"] for row in rows)
    yield from head([_label(name) for name in metrics])
    for name, cells in found.items():
        yield line(name, cells)


def _label(metric: str) -> str:
    return (METRICS | PLAN_METRICS)[metric].label


def _names(runs: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in runs)


def _counts(claims: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {said}" for said, count in sorted(claims.items()))


def _gain(found: Mapping[str, Any]) -> str:
    return f"{_signed(found)} {interval(found, '+.3f')}"


def _signed(found: Mapping[str, Any]) -> str:
    return "–" if found["difference"] is None else f"{found['difference']:+.3f}"


def _epochs(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """How many epochs the runs of which verdicts are had."""
    counts = sorted(
        {run["maps"] // run["samples"] for name, run in runs.items() if seeded(name)[1] is not None}
    )
    return (
        f" Those with the whole budget saw {' to '.join(f'{count:g}' for count in counts)} epochs."
        if counts
        else ""
    )


Study = Mapping[str, Any]
COLOURS = {"confirmed": "C0", "refuted": "C3", "contradicted": "C1", "undecided": "0.5"}
CURVES = {"val_loss": "validation loss", "val_iou": "IoU", "val_near_rmse": "Near-RMSE, m"}
"""What is shown of a run while it learns."""


def draw(study: Study) -> dict[str, bytes]:
    """Every picture by its file's name, PNG: the study's own, and those of its bench, of one seed.
    Raises ImportError without matplotlib."""
    own = {
        "learning.png": learning,
        "claims.png": claims,
        "choices.png": choices,
        "samples.png": samples,
    }
    found = {name: drawn(study) for name, drawn in own.items()}
    return {name: picture for name, picture in found.items() if picture} | of_bench.draw(
        _first_seed(study)
    )


def learning(study: Study) -> bytes:
    """Loss, IoU and Near-RMSE on validation by the maps that a run has seen; runs with the whole
    budget."""
    figure = _figure(12, 3.6)
    shown = {
        name: run
        for name, run in study["runs"].items()
        if run["against"] is None and name[-3:-1] == "-s"
    }
    kinds = list(dict.fromkeys(name[:-3] for name in shown))
    for axes, (column, title) in zip(figure.subplots(1, len(CURVES)), CURVES.items(), strict=True):
        for name, run in shown.items():
            dashes = "-" if run["seed"] == 0 else ":"
            points = [(row["maps"], row[column]) for row in run["curve"] if column in row]
            colour = f"C{kinds.index(name[:-3])}"
            axes.plot(*zip(*points, strict=True), dashes, marker=".", color=colour, label=name)
        axes.set(xlabel="maps seen", title=title)
        axes.grid(alpha=0.3)
        if column == "val_loss":
            axes.set_yscale("log")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize="small")
    return _png(figure)


def claims(study: Study) -> bytes | None:
    """Every claim's difference with its interval over worlds and seeds, in units of its metric;
    None where no claim has networks."""
    kinds = list(study["report"]["datasets"])
    tried = [claim for claim in study["claims"] if claim["pairs"]]
    if not tried:
        return None
    figure = _figure(
        12, 1.2 + 0.3 * max(sum(claim["kind"] == kind for claim in tried) for kind in kinds)
    )
    for axes, kind in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        rows = [claim for claim in tried if claim["kind"] == kind]
        _forest(
            axes,
            [f"{_title(one['metric'])}: {one['best']} before {one['other']}" for one in rows],
            [[one] for one in rows],
            [COLOURS[one["verdict"]] for one in rows],
        )
        axes.set_title(f"{kind}: better by", fontsize="medium")
    figure.suptitle(
        "blue: confirmed; red: refuted; orange: contradicted; grey: undecided", fontsize="small"
    )
    return _png(figure)


def choices(study: Study) -> bytes | None:
    """What each choice of the short runs is worth against the run that lacks it; None without such
    runs."""
    rows = study["contrasts"]
    if not rows:
        return None
    kinds, metrics = (list(dict.fromkeys(row[name] for row in rows)) for name in ("kind", "metric"))
    figure = _figure(13, 1 + 0.28 * len({row["run"] for row in rows}))
    for axes, metric in zip(figure.subplots(1, len(metrics), sharey=True), metrics, strict=True):
        held = [row for row in rows if row["metric"] == metric]
        names = list(dict.fromkeys((row["run"], row["against"]) for row in held))
        found = [[row for row in held if row["run"] == run] for run, _ in names]
        _forest(
            axes, [f"{run} against {against}" for run, against in names], found, ["C0"] * len(names)
        )
        axes.set(title=f"{_title(metric)}: better by ({', '.join(kinds)})")
    return _png(figure)


def samples(study: Study) -> bytes | None:
    """Error by the number of training samples, at as many maps seen; None without such runs."""
    fewer = [name for name, run in study["runs"].items() if "-of-" in name]
    if not fewer or (base := study["runs"][fewer[0]]["against"]) not in study["runs"]:
        return None
    tables, counts = (
        study["short"]["reconstruction"],
        {name: study["runs"][name]["samples"] for name in (*fewer, base)},
    )
    figure = _figure(9, 3.4)
    for axes, metric in zip(figure.subplots(1, 2), ("iou", "near_rmse"), strict=True):
        for kind, rows in tables.items():
            points = sorted((counts[name], rows[name][metric]) for name in counts)
            axes.errorbar(
                [count for count, _ in points],
                [value["mean"] for _, value in points],
                _errors([value for _, value in points]),
                marker=".",
                capsize=3,
                label=kind,
            )
        axes.set(xscale="log", xlabel="training samples", ylabel=_title(metric))
        axes.grid(alpha=0.3)
        axes.legend()
    return _png(figure)


def _forest(
    axes: Any,
    names: Sequence[str],
    rows: Sequence[Sequence[Mapping[str, Any]]],
    colours: Sequence[str],
) -> None:
    """A line a name, from the top; a point with an interval for each of its differences."""
    for n, (found, colour) in enumerate(zip(rows, colours, strict=True)):
        for m, one in enumerate(found):
            if one["difference"] is not None:
                shown = {"mean": one["difference"], "low": one["low"], "high": one["high"]}
                at = n + 0.2 * (m - (len(found) - 1) / 2)
                axes.errorbar(
                    one["difference"],
                    at,
                    xerr=_errors([shown]),
                    fmt="os"[m % 2],
                    color=colour,
                    markersize=4,
                )
    axes.axvline(0, color="grey", linewidth=0.8)
    axes.set_yticks(range(len(names)), names, fontsize="small")
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(alpha=0.3)


def _errors(figures: Sequence[Mapping[str, Any]]) -> list[list[float]]:
    """How far the intervals reach below and above the means, (2, N); 0 where there is none."""
    lows, highs = (
        [one["mean"] if one[end] is None else one[end] for one in figures]
        for end in ("low", "high")
    )
    means = [one["mean"] for one in figures]
    pairs = (
        (max(mean - low, 0), max(high - mean, 0))
        for mean, low, high in zip(means, lows, highs, strict=True)
    )
    below, above = zip(*pairs, strict=True)
    return [list(below), list(above)]


def _first_seed(study: Study) -> dict[str, Any]:
    """The bench's report without the rows of other seeds."""
    others = {name for name, run in study["runs"].items() if run["seed"]}
    report = study["report"]
    tables = {
        table: {
            kind: {name: row for name, row in rows.items() if name not in others}
            for kind, rows in report[table].items()
        }
        for table in ("reconstruction", "planning", "study")
    }
    return {**report, **tables}


def _title(metric: str) -> str:
    return (METRICS | PLAN_METRICS)[metric].label


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _png(figure: Any) -> bytes:
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=100)
    return memory.getvalue()
