"""Formats of single samples: point clouds, NumPy archives, SemanticKITTI, Occ3D, OctoMap and
WebDataset. The tables of classes have both scenegen's names and the format's own."""

import io
import json
import tarfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from lidarsim import Sensor
from lidarsim.grid import GridSpec, Ints
from scenegen.base.errors import DatasetError
from scenegen.convert import Choices
from scenegen.draw.movers import field_of
from scenegen.draw.sample import Sample
from scenegen.worlds.clouds.write import encode_npz, encode_points


def _numbers(lines: str) -> dict[str, int]:
    """Parse a table of lines, each a number and the names of the classes that have it."""
    table = [line.split() for line in lines.strip().splitlines()]
    return {name: int(number) for number, *names in table for name in names}


# without other-structure and other-object, which SemanticKITTI's own table maps to empty
SEMANTIC_KITTI = _numbers("""
10 car vehicle tyre
11 bicycle
13 bus
15 motorcycle
18 truck
20 other_vehicle
30 person
31 bicyclist
32 motorcyclist
40 road
44 parking
48 sidewalk
49 other_ground floor
50 building wall ceiling roof door column stairs beam
51 fence
60 lane_marking
70 vegetation
71 trunk
72 terrain
80 pole
81 traffic_sign sign
""")
"""Numbers of classes in `config/semantic-kitti.yaml` of github.com/PRBonn/semantic-kitti-api."""
OCC3D = _numbers("""
0 others other rock
1 barrier
2 bicycle
3 bus
4 car vehicle tyre
5 construction_vehicle
6 motorcycle
7 pedestrian person
8 traffic_cone
9 trailer
10 truck
11 driveable_surface road
12 other_flat floor
13 sidewalk
14 terrain
15 manmade building wall ceiling roof door column stairs beam pole sign fence
15 furniture shelf goods cable pipe tank machine
16 vegetation trunk
""")
"""Numbers of classes in Occ3D-nuScenes, of nuScenes' lidarseg; 17 is free."""
FUTURE_S = (0.5, 1, 2)
"""How long after a sample's time occupancy is written, seconds."""
MAX_LISTED = 12
"""Maximum names of classes in a note."""


class OneEach:
    """A format with a file for each sample, ``train/000007.ply``."""

    place, suffix = "{split}/{number:06d}", ""
    """Path of the file in the folder, without and with only the suffix."""
    classes: tuple[str, ...] = ()
    """Names of the classes of a dataset with labels, by number; `convert` sets them."""

    def __init__(self, choices: Choices):
        self.choices = choices

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """Return the path of a sample's file in the folder.

        Args:
            split: The sample's split.
            number: The sample's number in the split; of several in a file, the first one's.
        """
        return (self.place.format(split=split, number=number) + self.suffix,)


class SemanticFormat(OneEach):
    """A format with a number for each class of voxels."""

    numbers: Mapping[str, int]
    """Number of a class in the format, by the class's name."""
    empty: int
    """Number of voxels that are not occupied."""
    unlabelled: int
    """Number of occupied voxels of a dataset without labels."""
    fallback: int
    """Number of a class whose name is not in `numbers`."""

    def semantics(self, sample: Sample) -> Ints:
        """Return the format's number of each voxel's class (*grid.shape)."""
        if not self.classes:
            return np.where(sample.occupancy, self.unlabelled, self.empty)
        _, *classes = self.classes  # the first is of voxels that are not occupied
        numbers = [self.empty, *(self.numbers.get(name, self.fallback) for name in classes)]
        return np.array(numbers)[sample.voxel_class]

    def notes(self) -> list[str]:
        """Return a note if the format lacks classes of the dataset."""
        names = [name for name in self.classes[1:] if name not in self.numbers]
        suffix = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
        listed = f"{', '.join(names[:MAX_LISTED])}{suffix}"
        return [f"classes that the format lacks become {self.fallback}: {listed}"] if names else []


class Together(OneEach):
    """A format with a file for every hundred samples, ``train-000000.tar`` for the first."""

    place, together = "{split}-{number:06d}", 100

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """Return the path of the file that begins with a sample.

        Args:
            split: The sample's split.
            number: The sample's number in the split.
        """
        return super().names(split, number // self.together)


class Ply(OneEach):
    """Returns as binary PLY, little-endian: x, y, z in float32, metres."""

    suffix = ".ply"

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> bytes:
        """Return the content of a sample's file.

        Args:
            sample: The sample.
            grid: Grid of its map.
            lidar: Its sensor.
        """
        frame = self.choices.frame
        # points of several scans have no common sensor position
        is_single = sample.earlier_ranges is None
        header = {"frame": frame, "sensor_position": sample.position} if is_single else {}
        return encode_points(self.suffix, sample.points(lidar, frame=frame), about=header)


class Pcd(Ply):
    """Returns in the Point Cloud Library's format 0.7, binary. A single scan in the world's frame
    has the sensor's position as its viewpoint."""

    suffix = ".pcd"


class Npz(OneEach):
    """Every field of the sample under its name, the returns as `points`, the grid's `voxel_m`, and
    names of `classes` if there are labels; compressed. With `Choices.future` also `flow`,
    `occupancy+0.5` …, see `scenegen.draw.movers.SampleMotion`."""

    suffix = ".npz"

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> bytes:
        """Return the content of a sample's file.

        Args:
            sample: The sample.
            grid: Grid of its map.
            lidar: Its sensor.
        """
        fields = {name: getattr(sample, name) for name in sample.names}
        fields["points"] = sample.points(lidar, frame=self.choices.frame)
        fields["voxel_m"] = grid.voxel_m
        if self.classes:
            fields["classes"] = self.classes
        if self.choices.future:
            names = ("flow", *(f"occupancy+{after_s}" for after_s in FUTURE_S))
            fields |= {name: field_of(sample, name) for name in names}
        return encode_npz(fields)


class WebDataset(Together):
    """WebDataset's tar files, for loaders that stream (github.com/webdataset/webdataset, "The
    WebDataset format"). A sample is ``000007.npz``, see `Npz`, and ``000007.json`` with its number,
    world and viewpoint."""

    suffix = ".tar"

    def encode(self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor) -> bytes:
        """Return the content of a file; the same samples give the same bytes.

        Args:
            samples: Numbers and samples.
            grid: Grid of their maps.
            lidar: Their sensor.
        """
        npz, memory = Npz(self.choices), io.BytesIO()
        with tarfile.open(fileobj=memory, mode="w", format=tarfile.USTAR_FORMAT) as file:
            for number, sample in samples:
                facts = {
                    "number": number,
                    "world": int(sample.world),
                    "viewpoint": int(sample.viewpoint),
                }
                arrays = npz.encode(sample, grid, lidar)
                for ending, content in (("npz", arrays), ("json", json.dumps(facts).encode())):
                    # a member without times and owner: the same bytes whenever it is written
                    member = tarfile.TarInfo(f"{number:06d}.{ending}")
                    member.size = len(content)
                    file.addfile(member, io.BytesIO(content))
        return memory.getvalue()


SEQUENCES = {"train": (*range(8), 9, 10), "val": (8,), "test": range(11, 22)}
"""Sequences of each split in SemanticKITTI."""


class SemanticKitti(SemanticFormat):
    """SemanticKITTI's voxel grids, for programs that read its scene-completion task.

    ``sequences/07/voxels/000007.bin`` has the observed voxels, ``.label`` the ground truth,
    ``.occluded`` voxels that no ray met or crossed, and ``.invalid`` voxels that the map of a real
    place does not know, and with `Choices.unseen_invalid` the occluded ones. The development kit
    (semantic-kitti.org, "voxels") defines the layout: a grid in C order of x, y, z; `.label` is
    uint16, the others are bits, the first voxel highest. Its loader needs every sequence of a
    split, so samples are dealt to all of them in turn. Grids have the sensor at the centre and the
    world's axes, while SemanticKITTI's begin at the car.
    """

    numbers, empty = SEMANTIC_KITTI, 0

    def __init__(self, choices: Choices):
        super().__init__(choices)
        self.unlabelled = self.fallback = choices.label

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """Return the paths of a sample's four files in the folder.

        Args:
            split: The sample's split.
            number: The sample's number in the split.
        """
        sequences = SEQUENCES[split]
        stem = f"sequences/{sequences[number % len(sequences)]:02d}/voxels/{number:06d}"
        return tuple(f"{stem}.{kind}" for kind in ("bin", "label", "invalid", "occluded"))

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> tuple[bytes, ...]:
        """Return the contents of a sample's four files.

        Args:
            sample: The sample.
            grid: Grid of its map.
            lidar: Its sensor.
        """
        observed = sample.observed
        labels = self.semantics(sample).astype("<u2")
        unseen = ~(observed | sample.free)
        invalid = unseen & self.choices.unseen_invalid
        if sample.known is not None:
            invalid |= ~sample.known
        bits, *masks = (np.packbits(mask).tobytes() for mask in (observed, invalid, unseen))
        # in the order of `names`
        return bits, labels.tobytes(), *masks


class Occ3d(SemanticFormat):
    """Occ3D-nuScenes' labels (tsinghua-mars-lab.github.io/Occ3D), for programs that read its task
    of occupancy prediction.

    ``gts/train/000007/labels.npz`` (Occ3D has scene and token in place of split and number) holds
    uint8 arrays of the grid's shape: `semantics`; `mask_lidar`, 1 where a ray met or crossed the
    voxel; and `mask_camera`, 1 where the truth is known. There are no cameras: programs that score
    within `mask_camera` score all known voxels. Grids have the sensor at the centre and the world's
    axes, while Occ3D's begin 1 m below the car's origin and turn with it. With `Choices.future`,
    `flow` (*grid.shape, 2) has each voxel's velocity along x and y, m/s, as in OpenOcc's labels of
    the Occupancy and Flow challenge (github.com/OpenDriveLab/OccNet).
    """

    place, suffix = "gts/{split}/{number:06d}/labels", ".npz"
    numbers, empty = OCC3D, 17
    unlabelled, fallback = OCC3D["manmade"], OCC3D["others"]

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> bytes:
        """Return the content of a sample's file.

        Args:
            sample: The sample.
            grid: Grid of its map.
            lidar: Its sensor.
        """
        truth = sample.occupancy
        fields = {
            "semantics": self.semantics(sample),
            "mask_lidar": sample.observed | sample.free,
            "mask_camera": np.ones_like(truth) if sample.known is None else sample.known,
        }
        arrays: dict[str, Any] = {name: mask.astype(np.uint8) for name, mask in fields.items()}
        if self.choices.future:
            arrays["flow"] = sample.motion.flow()[..., :2]
        return encode_npz(arrays)


DEPTH = 16
"""Levels of an OctoMap."""
MIDDLE = 1 << (DEPTH - 1)
"""Key, along each axis, of the cell that begins at the world's origin."""
FREE, OCCUPIED, INNER = 1, 2, 3
"""Values of the two bits of a child; 0 is unknown."""


class OctoMap(OneEach):
    """OctoMap's binary trees of the sensor's map: observed cells are occupied, crossed ones free,
    in the world's frame.

    The format is that of `OcTree::writeBinary` (github.com/OctoMap/octomap): a text header, then
    the inner nodes depth first, two bits a child. Cells are multiples of the voxel from the world's
    origin, so the map moves by up to half a voxel along each axis.
    """

    suffix = ".bt"

    def encode(self, sample: Sample, grid: GridSpec, lidar: Sensor) -> bytes:
        """Return the content of a sample's file.

        Args:
            sample: The sample.
            grid: Grid of its map.
            lidar: Its sensor.

        Raises:
            DatasetError: The map lies too far from the world's origin for a tree.
        """
        known = np.argwhere(sample.observed | sample.free)
        keys = known + np.rint(sample.origin / grid.voxel_m).astype(np.int64) + MIDDLE
        if len(keys) and not (keys.min() >= 0 and keys.max() < 2 * MIDDLE):
            raise DatasetError(
                f"origin {sample.origin.tolist()}: beyond an OctoMap of {grid.voxel_m} m cells"
            )
        state = np.where(sample.observed[tuple(known.T)], OCCUPIED, FREE)
        nodes, tree = _tree(keys, state)
        # 17 digits restore every bit of the float
        header = f"id OcTree\nsize {nodes}\nres {grid.voxel_m:.17g}\ndata\n"
        return f"# Octomap OcTree binary file\n{header}".encode() + tree


def _tree(keys: Ints, state: Ints) -> tuple[int, bytes]:
    """Build a tree from its leaves upwards.

    Args:
        keys: Cells of the leaves (n, 3).
        state: FREE or OCCUPIED (n,).

    Returns:
        The number of nodes, and the inner ones as bytes.
    """
    if not len(keys):
        return 0, b""
    codes = np.zeros(len(keys), np.int64)  # Morton codes: three bits a level
    for bit in range(DEPTH):
        for axis in range(3):
            codes |= ((keys[:, axis] >> bit) & 1) << (3 * bit + axis)
    places, words = [], []
    # level by level, a parent gets two bits from each of its children
    for depth in reversed(range(DEPTH)):
        parents, parent_of = np.unique(codes >> 3, return_inverse=True)
        word = np.zeros(len(parents), np.uint16)
        # `at`, since several children have the same parent
        np.bitwise_or.at(word, parent_of, (state << (2 * (codes & 7))).astype(np.uint16))
        # depth first: by the first leaf that may lie below, and then by the depth
        places.append((parents << (3 * (DEPTH - depth))) * DEPTH + depth)
        words.append(word)
        codes, state = parents, np.full(len(parents), INNER)
    order = np.argsort(np.concatenate(places))
    return len(keys) + len(order), np.concatenate(words)[order].astype("<u2").tobytes()
