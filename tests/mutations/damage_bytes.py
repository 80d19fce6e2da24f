"""Family ``bytes``: flips, zeroed and random runs, truncation, splices, anywhere in a file."""

from tests.mutations.case import SAME, VALID
from tests.mutations.dataset_commands import read_dataset
from tests.mutations.datasets import sign


def damage(content, random):
    """Damaged bytes, and what was done to them."""
    size = len(content)
    at = random.randrange(size)
    length = min(random.choice((1, 2, 8, 50, 512, 4096)), size - at)

    def put(piece):
        return content[:at] + piece + content[at + len(piece) :]

    match random.randrange(6):
        case 0 | 1:
            data = bytearray(content)
            count = random.choice((1, 1, 2, 8, 64))
            places = [
                random.randrange(min(size, 2048) if random.random() < 0.5 else size)
                for _ in range(count)
            ]
            for place in places:
                data[place] ^= 1 << random.randrange(8)
            return bytes(data), f"bits flipped at {places[:8]}"
        case 2:
            values = bytes(length), b"\xff" * length, random.randbytes(length)
            return put(random.choice(values)), f"{length} bytes overwritten at {at}"
        case 3:
            kept = random.choice((0, 1, at, size - 1))
            return content[:kept], f"cut to {kept} of {size} bytes"
        case 4:
            source = random.randrange(size)
            return put(content[source : source + length]), f"bytes of {source} put at {at}"
        case _:
            return content[: at + length] + content[at:], f"{length} bytes at {at} doubled"


def attempt(random, valid, here):
    """A file of a dataset, damaged; sometimes signed again, so that its digest in the manifest
    holds."""
    name = random.choice("ddc")
    folder = valid.put(name, here)
    suffix = random.choice((".h5", ".h5", ".h5", ".zip", ".json"))
    path = random.choice(sorted(folder.glob(f"*{suffix}")))
    content, done = damage(path.read_bytes(), random)
    path.write_bytes(content)
    if suffix != ".json" and random.random() < 0.5:
        sign(folder)
        done += ", signed again"
    return read_dataset(
        random, valid, here, name, f"{name}/{path.name}: {done}", VALID if suffix == ".h5" else SAME
    )
