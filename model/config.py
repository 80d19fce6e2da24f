"""The settings of networks, objectives, runs, predictions and the bench: the only place where the
paper's numbers of them stand.

Nothing heavy is imported here, so that the command line can read its options from these fields.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from lidarsim.parameters import Checked, check, number, short_repr
from lidarsim.registry import Registry, suggestion
from scenegen.base.errors import ScenegenError, reraise_as
from scenegen.base.limits import (
    MAX_BATCH,
    MAX_CLASSES,
    MAX_EPOCHS,
    MAX_FEATURES,
    MAX_HEIGHT,
    MAX_MAPS,
    MAX_SEED,
    MAX_WIDTH,
)

BUNDLED = Path(__file__).parent / "weights"
"""Where the networks lie that come with scenegen."""
DEFAULT_NETWORK = "anywhere"
"""The one of them that is used if none is named."""
PREDICTIONS = "predictions.json"
"""The file of a folder of predictions that says whose they are, and of what."""
LEVELS = 3
STRIDE = 2**LEVELS
"""Every edge of a map is a multiple of so many voxels."""
TASKS = ("tudf", "occupancy")
SHARED = ("shared",)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Architecture of a network: its tasks, decoders and branches."""

    tasks: tuple[str, ...] = TASKS
    """Targets that it predicts, with a head for each: some of `TASKS`, in their order."""
    decoders: tuple[str, ...] = TASKS
    """Its decoders: one for each task, or `SHARED`."""
    coupled: bool = False
    """Whether its two decoders inform each other after every stage."""
    columns: tuple[int, ...] = ()
    """Channels, level by level, of a flat U-Net over whole columns beside its 3-D one; () for
    none."""


WIDE = 64, 96, 128
VARIANTS = {
    # the paper's network
    "proposed": Variant(coupled=True),
    # the paper's OCC-only
    "occ": Variant(tasks=("occupancy",), decoders=("occupancy",)),
    # the paper's TUDF-only
    "tudf": Variant(tasks=("tudf",), decoders=("tudf",)),
    # ours: one decoder for both tasks, and a flat U-Net over whole columns
    "columns": Variant(decoders=SHARED, columns=WIDE),
}
"""Every variant by its name; `scenegen.model.network` builds them."""

NETWORKS = Registry(
    "variant",
    dict.fromkeys(VARIANTS, "scenegen.model.network:Network"),
    needs={"load_state_dict": "a method, as every torch.nn.Module has it"},
)
"""Classes of networks, made from a `NetworkConfig`; docs/own-network.md describes a user's own."""
LOSSES = Registry("loss", {"coupled": "scenegen.model.losses:Coupled"})
"""Objectives: a class, made from (`LossConfig`, `GridSpec`), or a function: (output, batch) ->
terms."""
INPUTS = Registry(
    "input",
    {name: f"scenegen.model.inputs:{name}" for name in ("observed", "free", "distance")},
)
"""Channels that a network may take: functions of (sample or scan, grid, sensor)."""
HORIZONS = {"occupancy+0.5": 0.5, "occupancy+1": 1.0, "occupancy+2": 2.0}
"""Targets of occupancy at later times: how long after a sample's time, seconds."""
LATER = dict.fromkeys(HORIZONS, "scenegen.model.bench.moving:Later")
TARGETS = Registry(
    "target",
    {
        "occupancy": "scenegen.model.targets:Occupancy",
        "tudf": "scenegen.model.targets:Tudf",
        **LATER,
    },
)
"""Classes of targets that a network may predict; see `scenegen.model.targets.Target`."""
RESERVED = {
    "occupancy", "tudf", "observed", "known", "certain", "loss", "lovasz", "regression", "eikonal",
    "world", "viewpoint", "sha256", "occupancy_probability", "probability",
}  # fmt: skip
"""Names in batches, files and losses, which no target of a user's own may have."""
FIGURES = ("largest", "gradient", "best_iou", "best_probability", "best_distance_m")
"""Names of a run's figures, besides metrics, that no target, metric or term of a loss may have."""

OWN_METRICS = Registry("metric", LATER)
"""A user's own metrics of the bench, and targets that a dataset must have; those that come with
scenegen are `scenegen.model.bench.metrics.METRICS`, and always measured."""

METHODS = Registry(
    "method",
    {
        "empty": "scenegen.model.completion.protocol:Empty",
        "returns": "scenegen.model.completion.protocol:ReturnsCompleter",
        "conservative": "scenegen.model.completion.protocol:Conservative",
        "extrude": "scenegen.model.completion.protocol:Extrude",
        "truth": "scenegen.model.bench.methods:Truth",
        "seen": "scenegen.model.bench.visibility:Seen",
        "moved": "scenegen.model.bench.moving:MOVED",
        "flow": "scenegen.model.bench.moving:FLOW",
    },
)
"""Classes of completers and of the bench's rows, made without arguments; a user's own completer as
``module:Class``."""
USUAL = ("empty", "returns", "conservative", "extrude", "truth")
"""The rows without any named: `seen` compiles every world, and others are for datasets with
movers."""


def is_own(name: str) -> bool:
    """Check if a name is module:Object, code of a user's own."""
    return ":" in name


def target_name(name: str) -> str:
    """Return the name of a target in batches, outputs and predictions: "classes" for
    "my_labels:Classes"."""
    return name.rpartition(":")[2].lower()


def import_named(registry: Registry, name: str) -> Any:
    """Import an object of a registry.

    Args:
        registry: The registry.
        name: Name of the object.

    Returns:
        The object.

    Raises:
        ScenegenError: There is none; the message has one line.
    """
    with reraise_as(ScenegenError):
        return registry.find(name)


def split_own(weights: str | Path) -> tuple[frozenset[str], str]:
    """Split the name of a network into the user's own code that it grants, and the rest.

    "my_net:Net,my_input:rise@runs/mine" is the network in runs/mine, which may be made of these
    two. A file alone never has code imported, whatever its header says.

    Args:
        weights: The name.

    Returns:
        Names of objects, module:Object; and the name without them.
    """
    match = re.fullmatch(r"([\w.]+:\w+(?:,[\w.]+:\w+)*)@(.+)", str(weights))
    return (frozenset(match[1].split(",")), match[2]) if match else (frozenset(), str(weights))


def split_name(weights: str) -> tuple[str, str]:
    """Split NAME=WEIGHTS, by which a user names a network's row.

    Args:
        weights: The text.

    Returns:
        NAME, "" without one, and WEIGHTS.
    """
    # an existing path may have an equals sign of its own
    name, equals, place = weights.partition("=")
    named = equals and re.fullmatch(r"[\w. -]+", name) and not Path(split_own(weights)[1]).exists()
    return (name, place) if named else ("", weights)


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Settings of a network. "Paper" is the paper's section "Implementation Details"; "ours" are
    settings that it leaves open."""

    variant: str = "proposed"
    """Which of `VARIANTS`, or one's own as module:Class."""
    inputs: tuple[str, ...] = ("observed",)
    """Input channels, in their order (paper: `observed` alone); one's own as module:function."""
    targets: tuple[str, ...] = ()
    """Further targets, each as module:Class."""
    channels: tuple[int, ...] = number((), minimum=1, maximum=MAX_CLASSES)
    """How many channels each of these has; `train` takes it from the data."""
    width: int = number(8, minimum=1, maximum=MAX_WIDTH)
    """Channels at the first level; they double from level to level (paper)."""
    heads: int = number(4, minimum=1)
    """Heads of the self-attention (ours)."""
    height: int = number(40, minimum=2**LEVELS, maximum=MAX_HEIGHT)
    """Voxels of a map in z, for `columns` and for one's own; `train` takes it from the data."""

    def __post_init__(self) -> None:
        check(self)
        known = (NETWORKS, [self.variant]), (INPUTS, self.inputs), (TARGETS, self.targets)
        for registry, names in known:
            for name in names:
                if not is_own(name) and name not in registry.builtin:
                    raise ValueError(registry.unknown(name))
        if not self.inputs or len(set(self.inputs)) < len(self.inputs):
            raise ValueError(f"inputs = {short_repr(self.inputs)}: expected one or more, each once")
        targets = [*map(target_name, self.targets)]
        tasks = VARIANTS[self.variant].tasks if self.variant in VARIANTS else ()
        # only a user's own: built-in targets have these names by right
        new = {*map(target_name, filter(is_own, self.targets))}
        holders = {
            **dict.fromkeys(new & RESERVED, "an array or a term of the loss"),
            **dict.fromkeys(new & {*FIGURES}, "a figure of every run"),
            **dict.fromkeys(tasks, f"a task of the variant {self.variant}"),
            **dict.fromkeys(self.inputs, "an input of the network"),
            **dict.fromkeys((n for n in targets if targets.count(n) > 1), "another target, too"),
        }
        for name in filter(holders.get, targets):
            raise ValueError(
                f"targets = {short_repr(self.targets)}: expected new names, each once; {name} is "
                f"{holders[name]}; leave it out, or rename the class"
            )
        if self.width * 2 ** (LEVELS - 1) % self.heads:
            raise ValueError(
                f"width = {self.width}, heads = {self.heads}: {2 ** (LEVELS - 1)} times the width "
                "must be a multiple of the heads"
            )

    def channels_of(self, target: str) -> int:
        """Return the number of channels of a target, called by its `target_name`."""
        return dict(zip(map(target_name, self.targets), self.channels, strict=False)).get(target, 1)

    def check_map(self, shape: tuple[int, ...]) -> None:
        """Check that a network of this kind can complete maps.

        Args:
            shape: Shape of the maps.

        Raises:
            ValueError: It cannot.
        """
        if (known := VARIANTS.get(self.variant)) and any(edge % STRIDE for edge in shape):
            raise ValueError(
                f"maps of {shape} voxels; the network halves them three times, so every edge must "
                f"be a multiple of {STRIDE}"
            )
        if known and known.columns and shape[2] != self.height:
            raise ValueError(
                f"maps of {shape} voxels; this network sees columns of {self.height} voxels, no "
                f"others"
            )
        # memory grows with voxels times channels
        if math.prod(shape) * (features := max(self.width, *self.channels, 1)) > MAX_FEATURES:
            raise ValueError(
                f"maps of {shape} voxels at width {features}: expected "
                f"{MAX_FEATURES // features} voxels at most; give a smaller grid or --width"
            )


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the objective. "Paper" is the paper's section "Implementation Details"; "ours" are
    settings that it leaves open."""

    objective: str = "coupled"
    """The paper's, which the weights below are of, or one's own as module:Object."""
    occupancy: float = number(0.1, minimum=0)
    """lambda_occ (paper)."""
    tudf: float = number(1.0, minimum=0)
    """lambda_tudf (paper)."""
    eikonal: float = number(0.05, minimum=0)
    """lambda_eik (paper)."""
    occupied_weight: float = number(5.0, minimum=0)
    """w^o of occupied voxels; free ones have 1 (paper)."""
    lovasz: float = number(0.0, minimum=0)
    """Weight of the IoU's Lovász hinge beside the cross-entropy (ours; the paper has none)."""
    near_weight: float = number(2.0, minimum=0)
    """w^t of voxels near a surface; others have 1 (paper)."""
    near_m: float = number(0.5, minimum=0)
    """How near, metres (paper)."""
    beta_m: float = number(1.0, above=0)
    """Where Smooth-L1 turns from a parabola into a line, metres (ours)."""

    def __post_init__(self) -> None:
        check(self)
        if not is_own(self.objective) and self.objective not in LOSSES.builtin:
            raise ValueError(LOSSES.unknown(self.objective))


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything besides its datasets that decides the outcome of a run. "Paper" is the paper's
    section "Implementation Details"; "ours" are settings that it leaves open."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    epochs: int = number(100, minimum=1, maximum=MAX_EPOCHS)
    """Passes over the maps, at most (ours)."""
    maps: int | None = number(None, minimum=1, maximum=MAX_MAPS)
    """Maps seen, at most; it replaces `epochs` (ours)."""
    interval: int | None = number(None, minimum=1, maximum=MAX_MAPS)
    """Maps between two validations; by default, all maps once (ours)."""
    batch: int = number(8, minimum=1, maximum=MAX_BATCH)
    """Maps a step, over all devices (ours)."""
    optimizer: Literal["muon", "adamw"] = "muon"
    """The optimiser; docs/training.md compares them (ours)."""
    lr: float = number(1e-3, above=0)
    """Learning rate after the warm-up (ours)."""
    warmup_share: float = number(0.02, minimum=0, below=1)
    """Share of all steps over which the learning rate rises from 0 (ours)."""
    schedule: Literal["decay", "constant"] = "decay"
    """The learning rate. "decay": once validation stalls or the budget nears its end, it falls
    linearly to 0, and training ends (ours). "constant": no warm-up; training ends when validation
    stalls."""
    decay_share: float = number(0.2, above=0, below=1)
    """Share of all steps over which "decay" lets the learning rate fall (ours)."""
    weight_decay: float = number(0.01, minimum=0)
    """Weight decay (ours)."""
    decay_all: bool = False
    """Whether weight decay shrinks biases and the scales of norms, too (ours)."""
    clip: float = number(1.0, above=0)
    """Largest norm of a step's gradient (ours)."""
    patience: int = number(10, minimum=1)
    """Rounds without a lower validation loss after which validation has stalled (paper: epochs)."""
    choose: Literal["loss", "occupancy", "last"] = "loss"
    """The network that is kept: of the lowest validation loss, the lowest occupancy loss, or the
    last (ours)."""
    augment: bool = True
    """Whether maps are rotated about the sensor at random, and mirrored if its rays are
    mirror-symmetric (ours)."""
    points_share: float = number(0.0, minimum=0, maximum=1)
    """Share of maps that are shown as points only: rays without a return free nothing. Not for maps
    of several scans (ours)."""
    seed: int = number(0, minimum=0, maximum=MAX_SEED)
    """Seed of the first weights and of the order of samples."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Type of the network's arithmetic; losses and weights are float32. "auto": bfloat16 if the
    device has instructions for it."""
    compile: bool = False
    """Whether to run the network through torch.compile: slower on CPUs (docs/log)."""

    def __post_init__(self) -> None:
        check(self)
        known = VARIANTS.get(self.network.variant)
        if self.choose == "occupancy" and known and "occupancy" not in known.tasks:
            raise ValueError(
                f"choose = 'occupancy': the variant {self.network.variant!r} does not predict it"
            )

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> "TrainConfig":
        """Make a configuration from settings without nesting.

        Args:
            settings: Fields of this class, of `NetworkConfig` and of `LossConfig`, which have no
                name in common.

        Returns:
            The configuration.

        Raises:
            TypeError: There is no such setting.
            ValueError: A setting is out of its bounds.
        """
        # flat, as the options of the command line are
        left = dict(settings)
        network, loss = (
            {item.name: left.pop(item.name) for item in fields(part) if item.name in left}
            for part in (NetworkConfig, LossConfig)
        )
        return cls(network=NetworkConfig(**network), loss=LossConfig(**loss), **left)


PROTOCOLS: dict[str, dict[str, Any]] = {
    "ours": {},
    "paper": {"optimizer": "adamw", "schedule": "constant", "decay_all": True, "augment": False},
}
"""Named protocols: settings that replace the defaults of `TrainConfig`."""


@dataclass(frozen=True, kw_only=True)
class Thresholds(Checked):
    """Where a prediction becomes an obstacle. The paper's, section "Implementation Details"."""

    probability: float = number(0.85, minimum=0, maximum=1)
    """A voxel is occupied above this probability."""
    distance_m: float = number(0.2, minimum=0)
    """A voxel is occupied below this distance, where no probability is predicted, metres."""


UNITS = {"probability": "", "distance_m": " m"}
"""Of the fields of `Thresholds`."""
MAX_DRAWS = 1000
NEAR_M = 1.0
"""Distance up to which a voxel is near an obstacle, metres (paper)."""


@dataclass(frozen=True, kw_only=True)
class PlanConfig(Checked):
    """How paths are searched, refined and judged.

    "Paper" is the paper's section "Implementation Details" or "Planning Evaluation"; "ours" are
    settings that it leaves open.
    """

    planner: Literal["paper", "careful"] = "paper"
    """`paper`: the shortest path through free nodes, refined. `careful`: edges must be free, too,
    and paths are weighed by their risk (ours)."""
    step_voxels: int = number(3, minimum=1)
    """Lattice step of A*, voxels: 0.6 m at 0.2 m a voxel (paper)."""
    edge_check: bool = False
    """Whether A* also requires that the voxels between two nodes are free (ours)."""
    careful_probability: float = number(0.95, above=0, below=1)
    """Careful planner: probability above which a voxel is blocked (ours)."""
    unseen_risk: float = number(0.2, minimum=0, below=1)
    """Careful planner: minimum risk of an unknown voxel (ours)."""
    risk_weight: float = number(10.0, minimum=0)
    """Careful planner: cost of a metre at risk 1, in metres of detour (ours)."""
    safety_m: float = number(1.0, minimum=0)
    """d_s, the clearance below which waypoints are pushed away, metres; the paper gives no value
    (ours)."""
    clearance_weight: float = number(1.0, minimum=0)
    """lambda_c: weight of squared clearance deficits against squared second differences (paper)."""
    field: Literal["predicted", "transform"] = "predicted"
    """Distances for the refinement: the predicted ones, if any, or the transform of the occupancy
    (ours)."""
    iterations: int = number(50, minimum=0)
    """Steps of gradient descent (paper)."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig(Checked):
    """Settings of the bench: samples, trials, metrics and planner."""

    split: Literal["train", "val", "test"] = "test"
    """The split that is measured; calibration looks at val."""
    samples: int | None = number(None, minimum=1)
    """At most this many of the split's samples, evenly spread; None for all."""
    trials: int = number(2000, minimum=1)
    """Valid planning trials a dataset, spread over its samples (the paper's number)."""
    seed: int = number(0, minimum=0)
    """Seed of goals and permutations."""
    draws: int = number(1, minimum=1, maximum=MAX_DRAWS)
    """Answers of a method that draws, for each map; other methods give one."""
    metrics: tuple[str, ...] = ()
    """A user's own metrics, each as module:Object."""
    reliability: bool = False
    """Whether the report tells how reliable probabilities are, too."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    plan: PlanConfig = field(default_factory=PlanConfig)


def bundled() -> list[str]:
    """Names of the networks that come with scenegen."""
    return sorted(path.stem for path in BUNDLED.glob("*.safetensors"))


def unknown_network(name: str) -> str:
    """Message for a name of a network that does not exist."""
    hint = suggestion(name, bundled())
    return f"{name}: no such network; {hint}; or give a .safetensors file, or a run's folder"
