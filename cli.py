"""The command line: parse, call one function, print.

What a command needs is imported inside it, so that help is instant.
"""

from scenegen.terminal import stops

if stops.is_command():  # before anything is imported that takes long
    stops.answer()

import json
import os
import shlex
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

import rich_click as click
from click.shell_completion import get_completion_class

from scenegen import SPLITS, __version__
from scenegen.errors import ScenegenError
from scenegen.limits import MOST_BATCH, MOST_WIDTH, MOST_WORKERS
from scenegen.recipes import kind_names
from scenegen.terminal.command import run_command
from scenegen.terminal.options import DatasetPath, Finite, KindName, OutputFile, ShardRange
from scenegen.terminal.progress import Progress, announce_compilation, note
from scenegen.terminal.show import (
    flat,
    say,
    show_inspection,
    show_plan,
    show_published,
    show_report,
    show_summary,
    show_table,
)

VARIANTS = ("proposed", "occ", "tudf", "dual", "shared")

NETWORK_EDGE = 8
"""Its three halvings need edges of maps that are multiples of this."""
WORKERS = click.IntRange(min=1, max=MOST_WORKERS)


def main() -> NoReturn:
    """Run the command line."""
    run_command(app)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="scenegen")
def app() -> None:
    """Worlds, LiDAR scans and exact truth: datasets for 3D scene completion."""


@app.command()
@click.option("--kind", type=KindName(), help=f"Kind of random worlds: {', '.join(kind_names())}.")
@click.option("--scene", type=click.Path(path_type=Path), help="An MJCF world drawn by hand, or a folder of them.")
@click.option("--recipe", type=click.Path(path_type=Path), help="TOML file with what differs from the preset.")
@click.option("--n", type=click.IntRange(min=1), default=2500, show_default=True, help="Training samples.")
@click.option("--val", type=click.IntRange(min=0), help="Validation samples.  [default: a tenth of --n]")
@click.option("--test", type=click.IntRange(min=0), help="Test samples.  [default: a fifth of --n]")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="The same seed, the same dataset."
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the dataset.  [default: data/<kind>]")
@click.option("--workers", type=WORKERS, help="Processes.  [default: all cores]")
@click.option("--compact", is_flag=True, help="Leave out what readers can derive: free space and distances.")
@click.option("--shard-samples", type=click.IntRange(min=1), default=100, show_default=True, help="Samples in a file.")
@click.option("--split-range", type=ShardRange(), help="Only these shards, for a cluster; --dry-run counts them.")
@click.option("--allow-unseen", is_flag=True, help="Take scenes with geoms that rays cannot see; leave these out.")
@click.option("--force", is_flag=True, help="Replace another dataset in the folder.")
@click.option("--dry-run", is_flag=True, help="Say what would be made, and make nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def generate(
    kind: str | None,
    scene: Path | None,
    recipe: Path | None,
    n: int,
    val: int | None,
    test: int | None,
    workers: int | None,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Make a dataset: worlds, flights, scans and truth. Given again after a stop, it goes on where it was."""
    begin = time.perf_counter()
    single = scene is not None and not scene.is_dir()
    counts = {
        "train": n,
        "val": val if val is not None else 0 if single else max(n // 10, 1),
        "test": test if test is not None else 0 if single else max(n // 5, 1),
    }
    talk = not (quiet or as_json)
    if talk:
        announce_compilation()
    from scenegen.dataset.build import build, check_folder
    from scenegen.workers import cores

    plan = _plan(kind, scene, recipe, counts, options | {"talk": talk})
    shard_range = options["split_range"]
    if shard_range and shard_range[1] > len(plan.shards):
        raise click.UsageError(f"--split-range {shard_range[0]}:{shard_range[1]}: there are {len(plan.shards)} shards")
    check_folder(plan, force=options["force"])
    if talk and any(edge % NETWORK_EDGE for edge in plan.parameters["grid"]["shape"]):
        note(
            f"note: the bundled networks need edges that are multiples of {NETWORK_EDGE}, and grid.shape = "
            f"{plan.parameters['grid']['shape']}; other methods take any"
        )
    if dry_run:
        show_plan(plan, as_json)
        return
    chosen = plan.shards[slice(*shard_range)] if shard_range else plan.shards
    names = {shard.file.name for shard in chosen}

    def start() -> None:
        progress.start(sum(shard.samples for shard in chosen))

    def count(report: Any, fresh: bool) -> None:
        progress.count(report.samples if report.file in names else 0)

    with Progress(plan.parameters["kind"], shown=talk) as progress:
        summary = build(
            plan,
            workers=workers or cores(),
            shard_range=shard_range,
            force=options["force"],
            on_start=start,
            on_shard=count,
        )
    if as_json:
        print(json.dumps({**vars(summary), "folder": str(summary.folder), "seconds": time.perf_counter() - begin}))
    elif talk:
        show_summary(summary, time.perf_counter() - begin)


def _plan(kind: str | None, scene: Path | None, recipe_file: Path | None, counts: dict[str, int], options: Any) -> Any:
    """What the options ask for, resolved."""
    from scenegen.dataset.build import plan_dataset
    from scenegen.recipe import preset, read_recipe
    from scenegen.source import DrawnWorlds, Source, read_scenes

    if kind is None and scene is None and recipe_file is None:
        raise click.UsageError("give --kind, --scene or --recipe, for instance --kind pillar")
    if kind is not None and scene is not None:
        raise click.UsageError("--kind draws worlds and --scene reads them; give one of the two")
    named = "scene" if scene is not None else kind
    recipe = read_recipe(recipe_file, named) if recipe_file is not None else preset(str(named))
    source: Source
    if scene is not None:
        source = read_scenes(scene, counts, seed=options["seed"], allow_unseen=options["allow_unseen"])
        for line in source.notes if options["talk"] else ():
            note(line)
    elif recipe.world is None:
        raise click.UsageError(f'{recipe_file}: kind "scene" needs the worlds, too: give --scene')
    else:
        source = DrawnWorlds(recipe)
    return plan_dataset(
        options["out"] or Path("data") / (scene.stem if scene is not None else recipe.kind),
        recipe,
        source,
        seed=options["seed"],
        counts=counts,
        compact=options["compact"],
        shard_samples=options["shard_samples"],
    )


@app.command()
@click.argument("dataset", type=DatasetPath())
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def inspect(dataset: Path | str, as_json: bool) -> None:
    """Print what is in a dataset: counts, sizes, and statistics of scans and truth."""
    from scenegen.dataset.locate import locate
    from scenegen.inspect import inspect as examine

    found = examine(locate(dataset, shown=not as_json))
    if as_json:
        print(json.dumps(found))
    else:
        show_inspection(dataset, found)


@app.command()
@click.argument("dataset", type=DatasetPath())
@click.argument("number", type=click.IntRange(min=0))
@click.option("--split", type=click.Choice(SPLITS), default="train", show_default=True)
@click.option("-o", "--output", type=OutputFile(), help="MJCF file to write.  [default: standard output]")
def world(dataset: Path | str, number: int, split: str, output: Path | None) -> None:
    """Take one world's MJCF, and the files it refers to, out of a dataset."""
    from scenegen.dataset.extract import DOCUMENT, write_extracted
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    files = Dataset(locate(dataset, shown=True), partial=True).world(split, number)
    if output is not None:
        write_extracted(files, output)
        return
    if len(files) > 1:
        raise click.UsageError(f"this world refers to {len(files) - 1} other files; give -o: they go beside it")
    sys.stdout.buffer.write(files[DOCUMENT])


@app.command()
@click.argument("dataset", type=DatasetPath())
@click.option("--quick", is_flag=True, help="The cheap half: files, digests, numbers, laws, splits.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of what is audited at random.")
@click.option("--workers", type=WORKERS, help="Processes.  [default: all cores]")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def verify(dataset: Path | str, quick: bool, seed: int, workers: int | None, as_json: bool, quiet: bool) -> None:
    """Prove a dataset against the format: files, digests, truth, rays, splits; end with 1 where a check fails."""
    talk = not (quiet or as_json)
    if talk:
        announce_compilation()
    from scenegen.dataset.locate import locate
    from scenegen.verify import verify as prove
    from scenegen.workers import cores

    folder = locate(dataset, shown=talk)
    begin = time.perf_counter()
    with Progress("verify", shown=talk) as progress:
        report = prove(
            folder,
            quick=quick,
            seed=seed,
            workers=workers or cores(),
            on_start=progress.start,
            on_done=progress.count,
        )
    if as_json:
        print(json.dumps({**report.to_json(), "seconds": time.perf_counter() - begin}))
    elif talk:
        show_report(report, time.perf_counter() - begin)
    if not report.ok:
        raise ScenegenError(
            f"verify: {len(report.failed)} of {len(report.checks)} checks failed: {', '.join(report.failed)}"
        )


@app.command()
@click.argument("datasets", nargs=-1, type=DatasetPath())
@click.option(
    "--variant", type=click.Choice(VARIANTS), default="proposed", show_default=True, help="See docs/network.md."
)
@click.option("--epochs", type=click.IntRange(min=1), default=100, show_default=True, help="At most.")
@click.option(
    "--batch", type=click.IntRange(1, MOST_BATCH), default=8, show_default=True, help="Maps a step, on all devices."
)
@click.option("--lr", type=Finite(), default=1e-3, show_default=True, help="Learning rate after the warm-up.")
@click.option(
    "--patience", type=click.IntRange(min=1), default=10, show_default=True, help="Epochs without improvement."
)
@click.option(
    "--seed", type=click.IntRange(min=0, max=2**63 - 1), default=0, show_default=True, help="Of weights and order."
)
@click.option(
    "--width", type=click.IntRange(1, MOST_WIDTH), default=8, show_default=True, help="Channels at the first level."
)
@click.option("--stem-stride", type=click.Choice(["1", "2"]), default="2", show_default=True, help="1 is slower.")
@click.option("--beta", "beta_m", type=Finite(), default=1.0, show_default=True, help="Of Smooth-L1, metres.")
@click.option("--augment", is_flag=True, help="Turn and mirror maps about the sensor at random.")
@click.option("--precision", type=click.Choice(["auto", "float32", "bfloat16"]), default="auto", show_default=True)
@click.option("--compile", is_flag=True, help="Run the network through torch.compile.")
@click.option("--device", default="auto", show_default=True, help="cpu, cuda, cuda:1 …")
@click.option("--workers", type=click.IntRange(min=0), help="Loader processes.  [default: 0 on a CPU, else up to 8]")
@click.option("--out", type=click.Path(path_type=Path), help="The run's folder.  [default: runs/<variant>]")
@click.option("--resume", is_flag=True, hidden=True, help="Accepted from older scripts: a run goes on by itself.")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def train(datasets: tuple[Path | str, ...], variant: str, out: Path | None, quiet: bool, **options: Any) -> None:
    """Train the completion network on datasets; under torchrun, on several GPUs.

    Given again after a stop, it goes on where it was.
    """
    from scenegen.model.train_command import run_train

    quiet = quiet or int(os.environ.get("RANK", "0")) > 0
    with Progress(variant, shown=not quiet) as progress, stops.noted() as stop:  # the loop looks between two steps
        run_train(
            _found(datasets, shown=not quiet),
            variant=variant,
            out=out or Path("runs") / variant,
            options=options,
            command=shlex.join(["scenegen", *sys.argv[1:]]),
            progress=progress,
            say=(lambda line: None) if quiet else say,
            stop=stop,
        )


@app.command()
@click.argument("source", type=DatasetPath())
@click.option("--weights", default="proposed", show_default=True, help="A bundled name, a file, a run's folder, hf://…")
@click.option("--split", type=click.Choice(SPLITS), default="test", show_default=True)
@click.option("-o", "--output", type=OutputFile(), help="[default: predictions.h5, or <scan>.completed.h5]")
@click.option(
    "--sensor",
    type=(Finite(), Finite(), Finite()),
    default=(0.0, 0.0, 0.0),
    help="Where a scan's sensor was: X Y Z, m.",
)
@click.option("--device", default="auto", show_default=True, help="cpu, cuda, cuda:1 …")
@click.option("--batch", type=click.IntRange(1, MOST_BATCH), default=8, show_default=True, help="Maps at once.")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def complete(source: Path | str, weights: str, output: Path | None, quiet: bool, **options: Any) -> None:
    """Complete a dataset's split, or one scan (.ply, .xyz, .npy: points in metres, z up, sensor at the origin)."""
    from scenegen.dataset.locate import locate
    from scenegen.files import make_parent
    from scenegen.model.completion.completer import Completer
    from scenegen.model.completion.predictions import predict_scan, predict_split
    from scenegen.model.completion.protocol import Thresholds
    from scenegen.model.training.device import choose_device

    completer = Completer.from_pretrained(weights, device=choose_device(options["device"]), batch=options["batch"])
    found = locate(source, shown=not quiet)
    if found.is_dir():
        output = output or Path("predictions.h5")
        make_parent(output)
        there = output.exists()
        with Progress("complete", shown=not quiet) as progress:
            predict_split(
                completer,
                found,
                options["split"],
                output,
                batch=options["batch"],
                on_start=progress.start,
                on_done=progress.count,
            )
    else:
        output = output or found.with_suffix(".completed.h5")
        make_parent(output)
        there = output.exists()
        used = predict_scan(completer, found, output, sensor=options["sensor"], thresholds=Thresholds())
        if not quiet:
            say(f"{found}: {used}")
    if not quiet:
        say(f"{'replaced' if there else 'written'}: {output}")


@app.command()
@click.argument("weights", default="proposed")
@click.option("-o", "--output", type=OutputFile(), help="[default: <name>.onnx]")
def export(weights: str, output: Path | None) -> None:
    """Write a network as ONNX, for the runtimes that are fastest on CPUs."""
    from scenegen.files import make_parent
    from scenegen.model.checkpoint import load_network
    from scenegen.model.completion.completer import locate
    from scenegen.model.export import export_onnx

    network, grid, about = load_network(locate(weights))
    output = output or Path(f"{Path(weights).stem}.onnx")
    make_parent(output)
    export_onnx(network, grid, output, about=about)
    say(f"written: {output}")


@app.command()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def networks(as_json: bool) -> None:
    """Print what the network's variants cost: parameters, multiply-accumulates, memory."""
    from scenegen.model.summary import costs

    found = costs()
    if as_json:
        print(json.dumps(found))
        return
    say(f"{'variant':<10}{'stem stride':>12}{'parameters':>12}{'GMACs':>8}{'activations':>13}")
    for row in found:
        say(
            f"{row['variant']:<10}{row['stem_stride']:>12}{row['parameters']:>12,}{row['macs'] / 1e9:>8.2f}"
            f"{row['activation_bytes'] / 1e6:>10.1f} MB"
        )


@app.command()
@click.argument("datasets", nargs=-1, type=DatasetPath())
@click.option("--method", "names", multiple=True, help="A row: returns, conservative, extrude, truth, or MODULE:CLASS.")
@click.option("--weights", multiple=True, help="A network's row: a bundled name, a file, a run's folder, hf://…")
@click.option(
    "--predictions", type=click.Path(path_type=Path), help="HDF5 file of somebody's predictions: one more row."
)
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("bench"), show_default=True, help="Report's folder."
)
@click.option("--split", type=click.Choice(SPLITS), default="test", show_default=True, help="Calibrate on val alone.")
@click.option("--quick", is_flag=True, help="A tenth of the samples and trials: two minutes at most.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of goals and intervals.")
@click.option("--workers", type=WORKERS, help="Processes.  [default: all cores]")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def bench(datasets: tuple[Path | str, ...], names: tuple[str, ...], out: Path, quiet: bool, **options: Any) -> None:
    """Score completion methods on reconstruction and planning: the paper's two tables, and more in the report."""
    if not quiet:
        announce_compilation()
    from scenegen.model.bench.command import run_bench, tables
    from scenegen.workers import cores

    report = run_bench(
        _found(datasets, shown=not quiet),
        names=names,
        weights=options["weights"],
        predictions=options["predictions"],
        out=out,
        split=options["split"],
        quick=options["quick"],
        seed=options["seed"],
        workers=options["workers"] or cores(),
        command=shlex.join(["scenegen", *sys.argv[1:]]),
        progress=lambda label: Progress(label, shown=not quiet),
    )
    if not quiet:
        say(tables(report))
        say(f"\nwritten: {out / 'report.md'}, {out / 'report.json'}")


@app.command()
@click.argument("dataset", type=DatasetPath())
@click.option("--repo", required=True, metavar="USER/NAME", help="Dataset repository on the Hugging Face Hub.")
@click.option("--tag", help="Revision to give it, last of all.  [default: named by the content]")
@click.option("--licence", default="CC-BY-4.0", show_default=True, help="SPDX name of the data's licence.")
@click.option("--out", type=click.Path(path_type=Path), help="Where the folder goes.  [default: publish/<name>]")
@click.option("--private", is_flag=True, help="Make the repository a private one.")
@click.option("--dry-run", is_flag=True, help="Make the folder, list what would go, and contact nobody.")
@click.option("--quick", is_flag=True, help="Verify the cheap half: files, digests, numbers, laws.")
@click.option("--workers", type=WORKERS, help="Processes.  [default: all cores]")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def publish(
    dataset: Path | str, repo: str, out: Path | None, dry_run: bool, as_json: bool, quiet: bool, **options: Any
) -> None:
    """Verify a dataset, make a folder of it for the Hugging Face Hub, and send that.

    Given again after a stop, it goes on where it was. The token is the one that `hf auth login` keeps, or HF_TOKEN.
    """
    begin = time.perf_counter()
    talk = not (quiet or as_json)
    if talk:
        announce_compilation()
    from scenegen.dataset.locate import locate
    from scenegen.model.provenance import commit
    from scenegen.publish.run import publish as run_publish
    from scenegen.publish.stage import Request
    from scenegen.workers import cores

    request = Request(
        dataset=locate(dataset, shown=talk),
        repository=repo,
        out=out or Path("publish") / repo.rpartition("/")[2],
        tag=options["tag"],
        licence=options["licence"],
        commit=commit(),
    )
    with Progress("verify", shown=talk) as progress:

        def staged(found: Any) -> None:
            progress.stop()
            if talk:
                note(f"{found.folder} stands; {'nothing is sent' if dry_run else 'sending …'}")

        done = run_publish(
            request,
            dry_run=dry_run,
            private=options["private"],
            quick=options["quick"],
            workers=options["workers"] or cores(),
            shown=talk,
            on_start=progress.start,
            on_done=progress.count,
            on_staged=staged,
        )
    if not quiet:
        show_published(done, time.perf_counter() - begin, as_json)


@app.command()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def doctor(as_json: bool) -> None:
    """Check this machine: versions, cores, disk, GPU, and a two-second self-test."""
    if not as_json:
        announce_compilation()
    from scenegen.doctor import examine

    found = examine()
    if as_json:
        print(json.dumps(found))
    else:
        show_table(flat(found))
    if not found["ok"]:
        raise ScenegenError("the self-test failed: samples made here cannot be trusted; reinstall, then run it again")


@app.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print a completion script: eval "$(scenegen completion bash)"."""
    found = get_completion_class(shell)
    assert found is not None
    print(found(app, {}, "scenegen", "_SCENEGEN_COMPLETE").source())


def _found(datasets: tuple[Path | str, ...], *, shown: bool) -> tuple[Path, ...]:
    """The folders of the datasets named, or those under data/ that hold samples."""
    from scenegen.dataset.locate import locate
    from scenegen.dataset.manifest import read

    found = tuple(locate(dataset, shown=shown) for dataset in datasets)
    if not found:
        there = {path.parent: read(path.parent) for path in sorted(Path("data").glob("*/dataset.json"))}
        found = tuple(folder for folder, manifest in there.items() if manifest["shards"])
        for folder in there.keys() - set(found) if shown else ():
            note(f"{folder}: holds no samples yet, so it is left out")
    if not found:
        raise click.UsageError(
            "no dataset given, and none under data/; make one with `scenegen generate --kind pillar`"
        )
    return found


if __name__ == "__main__":
    main()
