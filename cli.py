"""The command line: parse, call one function, print.

What a command needs is imported inside it, so that help is instant.
"""

import json
import os
import shlex
import signal
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

import rich_click as click
from click.shell_completion import CompletionItem, get_completion_class

from scenegen import SPLITS, __version__
from scenegen.errors import ScenegenError, StoppedError
from scenegen.limits import MOST_BATCH, MOST_WIDTH
from scenegen.recipes import kind_names

EXTRAS = {"torch": "train", "safetensors": "train"}
"""Packages that commands need beyond the core, and the extra that brings each."""
VARIANTS = ("proposed", "occ", "tudf", "dual", "shared")

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STOPPED = "stopped; nothing finished is lost: give the same command again"
_stopped: list[int] = []


def main() -> NoReturn:
    """Run the command line. What goes wrong ends in one line on standard error."""
    for number in STOPS:  # until a command knows better, there is nothing to clean up
        signal.signal(number, _stop_now)
    try:
        app.main(prog_name="scenegen", standalone_mode=False)
        sys.stdout.flush()
        code, line = 0, ""
    except click.UsageError as error:
        name = error.ctx.command_path if error.ctx else "scenegen"
        code, line = 2, f"{' '.join(error.format_message().split())} (see {name} --help)"
    except click.ClickException as error:
        code, line = 1, error.format_message()
    except ScenegenError as error:
        code, line = (130 if isinstance(error, StoppedError) else 1), str(error)
    except (click.Abort, KeyboardInterrupt):
        code, line = 130, STOPPED
    except BrokenPipeError:
        code, line = 0, ""
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (nobody reads any more; keeps the interpreter from complaining)
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        code, line = 1, f"this needs {error.name}, which is not installed; pip install 'scenegen[{EXTRAS[error.name]}]'"
    except OSError as error:
        code, line = 1, f"{error.filename or 'the system'}: {error.strerror or error}; nothing finished is lost"
    except (MemoryError, RuntimeError) as error:
        memory = ("out of memory", "not enough memory", "can't allocate memory")  # as torch says it
        if isinstance(error, RuntimeError) and not any(text in str(error) for text in memory):
            raise
        code, line = 1, "out of memory; use smaller numbers (such as --batch), or a larger machine"
    if line:
        print(f"scenegen: {line}", file=sys.stderr)
    sys.exit(code)


class KindName(click.ParamType):
    """A kind of world; suggests the nearest where there is none of that name."""

    name = "kind"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name, if there is such a kind."""
        if value not in kind_names():
            import difflib

            near = difflib.get_close_matches(value, kind_names(), n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(kind_names())}"
            self.fail(f"unknown kind {value!r}; {hint}", param, ctx)
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Kinds that begin with what is typed."""
        return [CompletionItem(name) for name in kind_names() if name.startswith(incomplete)]


class DatasetPath(click.ParamType):
    """A dataset: a folder, or hf://user/name[@revision], which the command fetches, and not the parsing."""

    name = "dataset"

    def convert(self, value: Any, param: Any, ctx: Any) -> Path | str:
        """A path as it is, or the Hub's name, if it is one."""
        from scenegen.dataset.locate import is_remote, parse

        if not is_remote(value):
            return Path(value)
        parse(value)
        return str(value)

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        """Folders."""
        return [CompletionItem(incomplete, type="dir")]


class ShardRange(click.ParamType):
    """FIRST:STOP, as in Python: shard numbers from FIRST to one before STOP."""

    name = "first:stop"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """The two numbers."""
        first, colon, stop = str(value).partition(":")
        if not (colon and first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
            self.fail(f"{value!r} is not FIRST:STOP with FIRST < STOP, such as 0:8", param, ctx)
        return int(first), int(stop)


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
@click.option("--workers", type=click.IntRange(min=1), help="Processes.  [default: all cores]")
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
        _announce_compilation()
    from scenegen.dataset.build import build, check_folder
    from scenegen.workers import cores

    plan = _plan(kind, scene, recipe, counts, options)
    shard_range = options["split_range"]
    if shard_range and shard_range[1] > len(plan.shards):
        raise click.UsageError(f"--split-range {shard_range[0]}:{shard_range[1]}: there are {len(plan.shards)} shards")
    check_folder(plan, force=options["force"])
    if dry_run:
        _print_plan(plan, as_json)
        return
    chosen = plan.shards[slice(*shard_range)] if shard_range else plan.shards
    names = {shard.file.name for shard in chosen}

    def start() -> None:
        progress.start(sum(shard.samples for shard in chosen))

    def count(report: Any, fresh: bool) -> None:
        progress.count(report.samples if report.file in names else 0)

    for number in STOPS:  # from here on there are workers to end and drafts to remove
        signal.signal(number, _stop)
    with _Progress(plan.parameters["kind"], shown=talk) as progress:
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
        _print_summary(summary, time.perf_counter() - begin)


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
        _print_inspection(dataset, found)


@app.command()
@click.argument("dataset", type=DatasetPath())
@click.argument("number", type=click.IntRange(min=0))
@click.option("--split", type=click.Choice(SPLITS), default="train", show_default=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="MJCF file to write.  [default: standard output]")
def world(dataset: Path | str, number: int, split: str, output: Path | None) -> None:
    """Take one world's MJCF, and the files it refers to, out of a dataset."""
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset
    from scenegen.files import write_whole

    files = Dataset(locate(dataset, shown=True), partial=True).world(split, number)
    document = files.pop("world.xml")
    if output is None:
        if files:
            raise click.UsageError(f"this world refers to {len(files)} other files; give -o, they go beside it")
        sys.stdout.buffer.write(document)
        return
    output = output.resolve()
    if output.exists() and not output.is_file():
        raise click.UsageError(f"-o {output}: is there, and not a file; give another name")
    if not output.parent.is_dir():
        raise click.UsageError(f"-o {output}: there is no folder {output.parent}")
    for name, content in files.items():
        write_whole(output.parent / name, content)
    write_whole(output, document)


@app.command()
@click.argument("dataset", type=DatasetPath())
@click.option("--quick", is_flag=True, help="The cheap half: files, digests, numbers, laws, splits.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of what is audited at random.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes.  [default: all cores]")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def verify(dataset: Path | str, quick: bool, seed: int, workers: int | None, as_json: bool, quiet: bool) -> None:
    """Prove a dataset against the format: files, digests, truth, rays, splits; end with 1 where a check fails."""
    talk = not (quiet or as_json)
    if talk:
        _announce_compilation()
    from scenegen.dataset.locate import locate
    from scenegen.verify import verify as prove
    from scenegen.workers import cores

    folder = locate(dataset, shown=talk)
    for number in STOPS:  # from here on there are workers to end
        signal.signal(number, _stop)
    begin = time.perf_counter()
    with _Progress("verify", shown=talk) as progress:
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
        _print_report(report, time.perf_counter() - begin)
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
@click.option("--lr", type=float, default=1e-3, show_default=True, help="Learning rate after the warm-up.")
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
@click.option("--beta", "beta_m", type=float, default=1.0, show_default=True, help="Of Smooth-L1, metres.")
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
    from model.train_command import run_train

    asked: list[int] = []

    def note(number: int, frame: Any) -> None:
        if asked:  # for the second time
            os._exit(130)
        asked.append(number)

    for number in STOPS:  # the loop looks between two steps
        signal.signal(number, note)
    quiet = quiet or int(os.environ.get("RANK", "0")) > 0
    with _Progress(variant, shown=not quiet) as progress:
        run_train(
            _found(datasets, shown=not quiet),
            variant=variant,
            out=out or Path("runs") / variant,
            options=options,
            command=shlex.join(["scenegen", *sys.argv[1:]]),
            progress=progress,
            say=(lambda line: None) if quiet else click.echo,
            stop=lambda: bool(asked),
        )


@app.command()
@click.argument("source", type=DatasetPath())
@click.option("--weights", default="proposed", show_default=True, help="A bundled name, a file, a run's folder, hf://…")
@click.option("--split", type=click.Choice(SPLITS), default="test", show_default=True)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="[default: predictions.h5, or <scan>.completed.h5]"
)
@click.option(
    "--sensor", type=(float, float, float), default=(0.0, 0.0, 0.0), help="Where a scan's sensor was: X Y Z, m."
)
@click.option("--device", default="auto", show_default=True, help="cpu, cuda, cuda:1 …")
@click.option("--batch", type=click.IntRange(1, MOST_BATCH), default=8, show_default=True, help="Maps at once.")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def complete(source: Path | str, weights: str, output: Path | None, quiet: bool, **options: Any) -> None:
    """Complete a dataset's split, or one scan (.ply, .xyz, .npy: points in metres, z up, sensor at the origin)."""
    from model.complete import Thresholds
    from model.completer import Completer
    from model.device import choose_device
    from model.predict import predict_scan, predict_split
    from scenegen.dataset.locate import locate

    for number in STOPS:  # from here on there is a draft to remove
        signal.signal(number, _stop)
    completer = Completer.from_pretrained(weights, device=choose_device(options["device"]), batch=options["batch"])
    found = locate(source, shown=not quiet)
    if found.is_dir():
        output = output or Path("predictions.h5")
        there = output.exists()
        with _Progress("complete", shown=not quiet) as progress:
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
        there = output.exists()
        used = predict_scan(completer, found, output, sensor=options["sensor"], thresholds=Thresholds())
        if not quiet:
            click.echo(f"{found}: {used}")
    if not quiet:
        click.echo(f"{'replaced' if there else 'written'}: {output}")


@app.command()
@click.argument("weights", default="proposed")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="[default: <name>.onnx]")
def export(weights: str, output: Path | None) -> None:
    """Write a network as ONNX, for the runtimes that are fastest on CPUs."""
    from model.checkpoint import load_network
    from model.completer import locate
    from model.export import export_onnx

    for number in STOPS:
        signal.signal(number, _stop)
    network, grid, about = load_network(locate(weights))
    output = output or Path(f"{Path(weights).stem}.onnx")
    export_onnx(network, grid, output, about=about)
    click.echo(f"written: {output}")


@app.command()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def networks(as_json: bool) -> None:
    """Print what the network's variants cost: parameters, multiply-accumulates, memory."""
    from model.summary import costs

    found = costs()
    if as_json:
        print(json.dumps(found))
        return
    click.echo(f"{'variant':<10}{'stem stride':>12}{'parameters':>12}{'GMACs':>8}{'activations':>13}")
    for row in found:
        click.echo(
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
@click.option("--workers", type=click.IntRange(min=1), help="Processes.  [default: all cores]")
@click.option("--quiet", is_flag=True, help="Print errors alone.")
def bench(datasets: tuple[Path | str, ...], names: tuple[str, ...], out: Path, quiet: bool, **options: Any) -> None:
    """Score completion methods on reconstruction and planning: the paper's two tables, and more in the report."""
    if not quiet:
        _announce_compilation()
    from model.bench.command import run_bench, tables
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
        progress=lambda label: _Progress(label, shown=not quiet),
    )
    if not quiet:
        click.echo(tables(report))
        click.echo(f"\nwritten: {out / 'report.md'}, {out / 'report.json'}")


@app.command()
@click.argument("dataset", type=DatasetPath())
@click.option("--repo", required=True, metavar="USER/NAME", help="Dataset repository on the Hugging Face Hub.")
@click.option("--tag", help="Revision to give it, last of all.  [default: named by the content]")
@click.option("--licence", default="CC-BY-4.0", show_default=True, help="SPDX name of the data's licence.")
@click.option("--out", type=click.Path(path_type=Path), help="Where the folder goes.  [default: publish/<name>]")
@click.option("--private", is_flag=True, help="Make the repository a private one.")
@click.option("--dry-run", is_flag=True, help="Make the folder, list what would go, and contact nobody.")
@click.option("--quick", is_flag=True, help="Verify the cheap half: files, digests, numbers, laws.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes.  [default: all cores]")
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
        _announce_compilation()
    from model.provenance import commit
    from scenegen.dataset.locate import locate
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
    for number in STOPS:  # from here on there are workers to end and drafts to remove
        signal.signal(number, _stop)
    with _Progress("verify", shown=talk) as progress:

        def staged(found: Any) -> None:
            _raise_if_stopped()
            progress.stop()
            if talk:
                print(f"{found.folder} stands; {'nothing is sent' if dry_run else 'sending …'}", file=sys.stderr)

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
        _print_published(done, time.perf_counter() - begin, as_json)


@app.command()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def doctor(as_json: bool) -> None:
    """Check this machine: versions, cores, disk, GPU, and a two-second self-test."""
    if not as_json:
        _announce_compilation()
    from scenegen.doctor import examine

    found = examine()
    if as_json:
        print(json.dumps(found))
    else:
        _print_table(_flat(found))
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
    """The folders of the datasets named, or those under data/."""
    from scenegen.dataset.locate import locate

    found = tuple(locate(dataset, shown=shown) for dataset in datasets)
    found = found or tuple(path.parent for path in sorted(Path("data").glob("*/dataset.json")))
    if not found:
        raise click.UsageError(
            "no dataset given, and none under data/; make one with `scenegen generate --kind pillar`"
        )
    return found


def _stop_now(number: int, frame: Any) -> NoReturn:
    os.write(2, f"scenegen: {STOPPED}\n".encode())
    os._exit(130)


def _stop(number: int, frame: Any) -> NoReturn:
    _stopped.append(number)
    raise StoppedError(STOPPED)


def _raise_if_stopped() -> None:
    """For an exception that `_stop` raised in a library's callback, and that was lost there."""
    if _stopped:
        raise StoppedError(STOPPED)


def _announce_compilation() -> None:
    """Say why the first run takes longer."""
    from lidarsim.jit import cache_folder

    if not any(cache_folder("scenegen").rglob("*.nbc")):
        print("compiling kernels: once on this machine, about 20 seconds …", file=sys.stderr)


class _Progress:
    """Progress on standard error: samples, rate, time left. It runs a thread, so it begins after the workers."""

    def __init__(self, label: str, *, shown: bool):
        self._label = label
        self._shown = shown
        self._done = 0
        self._bar: Any = None

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.stop()

    def start(self, total: int) -> None:
        """Show the bar, of `total` samples less those counted already."""
        _raise_if_stopped()
        if not self._shown:
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._begin, self._at_begin = time.perf_counter(), self._done
        self._task = self._bar.add_task(self._label, total=total, completed=self._done, rate="")
        self._bar.start()

    def restart(self, label: str, total: int, done: int) -> None:
        """Show a new bar of `total` samples, `done` of them already."""
        if self._bar is not None:
            self._bar.stop()
        self._label, self._done = label, done
        self.start(total)

    def note(self, text: str) -> None:
        """Show `text` behind the label."""
        if self._bar is not None:
            self._bar.update(self._task, description=f"{self._label} {text}")

    def count(self, samples: int) -> None:
        """Count samples as done."""
        _raise_if_stopped()
        self._done += samples
        if self._bar is not None:
            rate = (self._done - self._at_begin) / max(time.perf_counter() - self._begin, 1e-9)
            self._bar.update(self._task, completed=self._done, rate=f"{rate:.0f} samples/s")


def _print_table(rows: dict[str, Any], title: str = "") -> None:
    if title:
        click.echo(f"\n{title}")
    width = max(len(name) for name in rows)
    for name, value in rows.items():
        click.echo(f"{click.style(name.ljust(width), bold=True)}  {value}")


def _print_plan(plan: Any, as_json: bool) -> None:
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
        _print_table(_flat(rows), "would make")


def _print_summary(summary: Any, seconds: float) -> None:
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
    _print_table(rows)


def _print_report(report: Any, seconds: float) -> None:
    rows = {}
    for check in report.checks:
        verdict = "FAILED " if not check.ok else "skipped" if check.skipped else "ok     "
        colour = "red" if not check.ok else "yellow" if check.skipped else "green"
        rows[check.name] = f"{click.style(verdict, fg=colour)}  {check.seconds:7.2f} s  {check.detail}"
    _print_table(rows)
    click.echo(f"\n{report.samples} samples in {seconds:.1f} s, {report.samples / seconds:.0f} a second")


def _print_published(done: Any, seconds: float, as_json: bool) -> None:
    staged = done.staged
    url = f"https://huggingface.co/datasets/{staged.repository}/tree/{staged.tag}"
    size = sum(staged.files.values())
    if as_json:
        rows = {"folder": str(staged.folder), "repository": staged.repository, "tag": staged.tag, "commit": done.commit}
        print(json.dumps({**rows, "digest": staged.digest, "files": staged.files, "bytes": size, "seconds": seconds}))
        return
    if done.commit is None:
        _print_table({name: f"{size:>12,}" for name, size in staged.files.items()}, "would send, in bytes")
    _print_table(
        {
            "folder": staged.folder,
            "files": f"{len(staged.files)}, {size / 1e6:.1f} MB",
            "revision": f"hf://{staged.repository}@{staged.tag}",
            "time": f"{seconds:.1f} s",
            **({"next": "the same command without --dry-run"} if done.commit is None else {"page": url}),
        },
        "published" if done.commit else "ready",
    )


def _print_inspection(dataset: Path | str, found: dict[str, Any]) -> None:
    _print_table(
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
        _print_table(rows, title)


def _per_split(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _rejections(rejected: dict[str, dict[str, int]]) -> str:
    parts = [f"{what} {_per_split(counts)}" for what, counts in rejected.items() if counts]
    return "; ".join(parts) or "none"


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, names joined by dots."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


if __name__ == "__main__":
    main()
