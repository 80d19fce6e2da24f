"""Keep the state of the replication's runs in few bytes, for a machine that is lost.

    python benchmarks/paper/state.py save ROOT       # ROOT/runs → benchmarks/paper/state
    python benchmarks/paper/state.py restore ROOT    # back, for runs that ROOT lacks

Weights are stored as float16. Of AdamW's moments, the second ones are stored as eight bits of their
logarithm; the first ones, which are a mean over some ten steps, begin at zero again. So a restored
run is close to the stopped one, and not equal to it: `config.json` then says so.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from scenegen.model.checkpoint import load_tensors, save_tensors

STATE = Path(__file__).parent / "state"
LOWEST_LOG2, STEPS = -80.0, 254
"""Second moments from 2^-80 to 1 have the codes 1 to 255; smaller ones have 0."""


@dataclass
class Options:
    """What to do, and where the runs are."""

    action: tyro.conf.Positional[Literal["save", "restore"]]
    root: tyro.conf.Positional[Path]


def encode_moment(moment: Tensor) -> Tensor:
    """Positive numbers (any shape, float32) as uint8 codes of their logarithm."""
    share = 1 - moment.clamp(min=2.0**LOWEST_LOG2).log2() / LOWEST_LOG2
    code = 1 + (share * STEPS).round().clamp(0, STEPS)
    return torch.where(moment < 2.0**LOWEST_LOG2, 0, code).to(torch.uint8)


def decode_moment(code: Tensor) -> Tensor:
    """The numbers that `encode_moment` encoded, to within 12 %; 0 for what was too small."""
    exponent = LOWEST_LOG2 * (1 - (code.float() - 1) / STEPS)
    return torch.where(code == 0, 0.0, exponent.exp2())


def save(run: Path, file: Path) -> None:
    """Write the compact state of the run in the folder `run`."""
    tensors: dict[str, Tensor] = {}
    headers = {}
    for part in ("last", "best"):
        path = run / f"{part}.safetensors"
        if not path.exists():
            continue
        held, headers[part] = load_tensors(path)
        for name, tensor in held.items():
            if name.endswith("/exp_avg"):
                continue
            if name.endswith("/exp_avg_sq"):
                tensors[f"{part}/{name}"] = encode_moment(tensor)
            elif tensor.dtype == torch.float32 and tensor.ndim > 1:
                tensors[f"{part}/{name}"] = tensor.half()
            else:  # of few numbers: biases, statistics, counts
                tensors[f"{part}/{name}"] = tensor
    about = {"headers": json.dumps(headers), "config": (run / "config.json").read_text()}
    save_file(tensors, file, about)


def restore(file: Path, run: Path) -> None:
    """Make the folder of a run that `save` wrote."""
    with safe_open(file, "pt") as held:
        about = held.metadata()
        tensors = {name: held.get_tensor(name) for name in held.keys()}  # noqa: SIM118
    run.mkdir(parents=True)
    for part, header in json.loads(about["headers"]).items():
        plain = {}
        for name, tensor in tensors.items():
            place, _, name = name.partition("/")
            if place != part:
                continue
            if name.endswith("/exp_avg_sq"):
                plain[name] = decode_moment(tensor)
                plain[name.removesuffix("_sq")] = torch.zeros(tensor.shape)
            else:
                plain[name] = tensor.float() if tensor.dtype == torch.float16 else tensor
        save_tensors(run / f"{part}.safetensors", plain, header)
    config = json.loads(about["config"]) | {"restored": f"from {file.name}, float16 weights"}
    (run / "config.json").write_text(json.dumps(config, indent=1) + "\n")


def main() -> None:
    """Save or restore every run."""
    options = tyro.cli(Options, description=__doc__)
    if options.action == "save":
        STATE.mkdir(exist_ok=True)
        for run in sorted((options.root / "runs").glob("*-s*")):
            if (run / "last.safetensors").exists():
                save(run, STATE / f"{run.name}.safetensors")
                print(f"saved {run.name}")
        return
    for file in sorted(STATE.glob("*.safetensors")):
        run = options.root / "runs" / file.stem
        if not run.exists():
            restore(file, run)
            print(f"restored {run.name}")


if __name__ == "__main__":
    main()
